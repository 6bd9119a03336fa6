#include "control/estimator.h"

/* An update needs the gate open over this much of the filter's window. */
#define LEAST_OPEN SCALAR(0.02)

/* Rows in turn: one update a tick keeps the longest tick short, and samples of a filtered row that follow one
 * another hold little that is new. */
#define ROW_TURNS 4

/* This many innovations in a row that are too large mean a changed load. */
#define STRIKES 3

/* The load's variance grows in steps of this many updates: one update's share is too small for short words. */
#define WALK_UPDATES 50

static const uint8_t hydraulic_parameter[JOINTS][HYDRAULIC_COLUMNS] = {
    [SWING] = {BETA_INVERSE, OM2_SWING, OM3_SWING},
    [WRIST] = {BETA_INVERSE, OM2_WRIST, OM3_WRIST},
};

struct estimator_constants estimator_constants(const struct estimator_parameters *parameters, scalar dt_s)
{
    struct estimator_constants constants = {0};
    constants.filter = quot(dt_s, parameters->filter_time + dt_s);
    constants.per_tick = gain_quot(SCALAR(1), dt_s);
    constants.filter_rate = gain_quot(constants.filter, dt_s);
    for (uint8_t i = 0; i < JOINTS; i++) {
        constants.noise_m[i] = variance_of(parameters->torque_noise[i]);
        constants.noise_h[i] = variance_of(parameters->flow_noise[i]);
    }
    for (uint8_t k = 0; k < THETA_M; k++) {
        constants.scale_m[k] = parameters->m[k].high - parameters->m[k].low;
        constants.step_m[k] = mul(constants.scale_m[k], amp(parameters->rate_limit, dt_s));
    }
    for (uint8_t k = 0; k < THETA_H; k++) {
        constants.scale_h[k] = parameters->h[k].high - parameters->h[k].low;
        constants.step_h[k] = mul(constants.scale_h[k], amp(parameters->rate_limit, dt_s));
    }
    /* two updates, one per row of the mechanics, every ROW_TURNS ticks */
    const scalar walk_s = mul(dt_s, SCALAR(WALK_UPDATES * ROW_TURNS / 2));
    constants.walk = scale_variance(variance_of(quot(parameters->load_walk, constants.scale_m[M_T])), walk_s);
    constants.load_variance = variance_of(quot(parameters->m[M_T].sd, constants.scale_m[M_T]));
    return constants;
}

/* Commissioning knows a parameter to a quarter of its range. */
#define WIDE_SD SCALAR(0.25)

static void start_covariance(const struct prior prior[], uint8_t size, const scalar scale[],
                             struct ud_factors *covariance)
{
    variance P[UD_SIZE_MAX];
    for (uint8_t k = 0; k < size; k++) {
        P[k] = variance_of(quot(prior[k].sd, scale[k]));
    }
    ud_start(covariance, size, P);
}

static void start_block(const struct prior prior[], uint8_t size, const scalar scale[], scalar theta[],
                        scalar law[], struct ud_factors *covariance)
{
    for (uint8_t k = 0; k < size; k++) {
        theta[k] = prior[k].value;
        law[k] = prior[k].value;
    }
    start_covariance(prior, size, scale, covariance);
}

void estimator_start(struct estimator *estimator, const struct estimator_parameters *parameters,
                     const struct estimator_constants *constants)
{
    *estimator = (struct estimator){0};
    start_block(parameters->m, THETA_M, constants->scale_m, estimator->theta_m, estimator->law_m,
                &estimator->covariance_m);
    start_block(parameters->h, THETA_H, constants->scale_h, estimator->theta_h, estimator->law_h,
                &estimator->covariance_h);
    estimator_resume(estimator);
}

void estimator_commission(struct estimator *estimator)
{
    variance wide[UD_SIZE_MAX];
    for (uint8_t k = 0; k < UD_SIZE_MAX; k++) {
        wide[k] = variance_of(WIDE_SD);
    }
    ud_start(&estimator->covariance_m, THETA_M, wide);
    ud_start(&estimator->covariance_h, THETA_H, wide);
    estimator->covariance_m.D[M_T] = VARIANCE(0);
    estimator->theta_m[M_T] = SCALAR(0);
    estimator->commissioning = true;
    estimator_resume(estimator);
}

void estimator_operate(struct estimator *estimator, const struct estimator_parameters *parameters,
                       const struct estimator_constants *constants)
{
    start_covariance(parameters->m, THETA_M, constants->scale_m, &estimator->covariance_m);
    start_covariance(parameters->h, THETA_H, constants->scale_h, &estimator->covariance_h);
    estimator->theta_m[M_T] = parameters->m[M_T].value;
    estimator->commissioning = false;
    estimator_resume(estimator);
}

/* Empty filters; the balances go on from the samples that are there. */
static void start_filters(struct estimator *estimator)
{
    for (uint8_t i = 0; i < JOINTS; i++) {
        for (uint8_t k = 0; k <= ROW_COLUMNS; k++) {
            estimator->row_m[i][k] = (struct two_poles){0};
        }
        for (uint8_t k = 0; k <= HYDRAULIC_COLUMNS; k++) {
            estimator->row_h[i][k] = (struct two_poles){0};
        }
        estimator->open[i] = (struct two_poles){0};
        estimator->previous_gate[i] = SCALAR(0);
        estimator->strikes[i] = 0;
        estimator->strikes_h[i] = 0;
    }
    estimator->ramp = SCALAR(0);
}

void estimator_resume(struct estimator *estimator)
{
    start_filters(estimator);
    estimator->samples = 0;
    estimator->since_update = ROW_TURNS;
    estimator->updating = false;
}

static void low_pass(struct two_poles *filter, scalar pole_step, scalar x)
{
    filter->first += mul(pole_step, x - filter->first);
    filter->second += mul(pole_step, filter->first - filter->second);
}

/* The same of step / dt + x. */
static void low_pass_rate(struct two_poles *filter, const struct estimator_constants *constants, scalar step,
                          scalar x)
{
    filter->step += step - mul(constants->filter, filter->step);
    filter->first += mul(constants->filter, x - filter->first);
    const scalar first = filter->first + amp(constants->filter_rate, filter->step);
    filter->second += mul(constants->filter, first - filter->second);
}

/* 0 at rest, 1 from twice the gate's rate on. */
static scalar gate(const struct estimator_parameters *parameters, scalar reference_w)
{
    const scalar excess = absolute(reference_w) - parameters->gate_rate;
    return limit(quot(excess, parameters->gate_rate), SCALAR(0), SCALAR(1));
}

/* Momentum balance of joint i over the sample (k-3/2, k-1/2), gated and filtered, Eq 25. */
static void mechanics_balance(struct estimator *e, const struct estimator_constants *constants,
                              const struct arm *arm, enum joint i, const struct wrist_trig *half_trig,
                              const scalar half_w[JOINTS])
{
    const struct estimator_sample *const at = &e->previous; /* the instant k-1, in the middle */
    struct arm_row momentum;
    arm_momentum(arm, half_trig, i, half_w, &momentum);
    if (e->samples >= 2u) {
        scalar middle_w[JOINTS];
        for (uint8_t n = 0; n < JOINTS; n++) {
            middle_w[n] = mul(SCALAR(0.5), e->previous_w[n] + half_w[n]);
        }
        struct arm_row force;
        arm_force(arm, &at->trig, i, middle_w, at->reference_w[i], at->lever[i], &force);
        const struct arm_row *const before = &e->previous_momentum[i];
        const scalar g = e->previous_gate[i];
        for (uint8_t k = 0; k < ROW_COLUMNS; k++) {
            low_pass_rate(&e->row_m[i][k], constants, mul(g, momentum.phi[k] - before->phi[k]),
                          mul(g, force.phi[k]));
        }
        const scalar torque = mul(at->cylinder[i].R, at->force[i]);
        low_pass_rate(&e->row_m[i][ROW_COLUMNS], constants, mul(g, momentum.known - before->known),
                      mul(g, force.known - torque));
    }
    e->previous_momentum[i] = momentum;
}

/* Flow balance of joint i over the sample (k-1, k), gated and filtered: Eq 6 in the form of Eq 25. */
static void hydraulics_balance(struct estimator *e, const struct estimator_parameters *parameters,
                               const struct estimator_constants *constants, enum joint i, scalar half_w,
                               const struct estimator_sample *now)
{
    const struct estimator_sample *const before = &e->previous;
    const struct cylinder_state *const c0 = &before->cylinder[i];
    const struct cylinder_state *const c1 = &now->cylinder[i];
    const scalar half = SCALAR(0.5);
    const scalar noise = parameters->flow_noise[i];
    const scalar flow_error = mul(parameters->flow_error, absolute(before->flow[i]));
    const scalar g = mul(e->previous_gate[i], quot(noise, noise + flow_error));
    const scalar displaced = mul(mul(half, mul(c0->lamA, c0->R) + mul(c1->lamA, c1->R)), half_w);
    const scalar flow = mul(half, before->flow[i] + now->flow[i]);
    struct two_poles *const row = e->row_h[i];
    low_pass_rate(&row[0], constants, mul(g, now->force[i] - before->force[i]), SCALAR(0));
    low_pass(&row[1], constants->filter, -mul(g, mul(half, c0->lamB + c1->lamB)));
    low_pass(&row[2], constants->filter, -mul(g, mul(half, c0->lamC + c1->lamC)));
    low_pass(&row[3], constants->filter, mul(g, displaced - flow));
}

/* The innovation test of the load: too large several times in a row, and the load alone is open again. */
static void notice_changed_load(struct estimator *e, const struct estimator_parameters *parameters,
                                const struct estimator_constants *constants, enum joint i, scalar residual,
                                variance innovation)
{
    if (absolute(residual) <= mul(parameters->innovation_limit, sd_of(innovation))) {
        e->strikes[i] = 0;
        return;
    }
    e->strikes[i]++;
    if (e->strikes[i] < STRIKES) {
        return;
    }
    e->covariance_m.D[M_T] = constants->load_variance;
    if (e->reopened < UINT16_MAX) {
        e->reopened++;
    }
    start_filters(e);
}

/* theta += K residual, then projection onto the bounds, Eq 21: integrate, then clamp. Returns the variance that
 * the residual was expected to have. */
static variance update_block(struct ud_factors *covariance, const scalar phi[], variance noise,
                             scalar residual, const scalar scale[], const struct prior prior[],
                             scalar theta[])
{
    gain K[UD_SIZE_MAX];
    const variance innovation = ud_update(covariance, phi, noise, K);
    for (uint8_t k = 0; k < covariance->size; k++) {
        theta[k] = limit(theta[k] + mul(scale[k], amp(K[k], residual)), prior[k].low, prior[k].high);
    }
    return innovation;
}

/* The load's random walk, up to its bound. */
static void walk(struct estimator *e, const struct estimator_constants *constants)
{
    e->walk_updates++;
    if (e->walk_updates < WALK_UPDATES) {
        return;
    }
    e->walk_updates = 0;
    if (ud_variance(&e->covariance_m, M_T) < constants->load_variance) {
        e->covariance_m.D[M_T] += constants->walk;
    }
}

static void update_mechanics(struct estimator *e, const struct estimator_parameters *parameters,
                             const struct estimator_constants *constants, enum joint i)
{
    scalar phi[THETA_M] = {0};
    scalar residual = -e->row_m[i][ROW_COLUMNS].second;
    for (uint8_t k = 0; k < ROW_COLUMNS; k++) {
        const uint8_t parameter = row_parameter[i][k];
        const scalar column = e->row_m[i][k].second;
        residual -= mul(column, e->theta_m[parameter]);
        phi[parameter] = mul(column, constants->scale_m[parameter]);
    }
    if (!e->commissioning) {
        walk(e, constants);
    }
    const variance innovation = update_block(&e->covariance_m, phi, constants->noise_m[i], residual,
                                             constants->scale_m, parameters->m, e->theta_m);
    if (!e->commissioning) {
        notice_changed_load(e, parameters, constants, i, residual, innovation);
    }
}

static void update_hydraulics(struct estimator *e, const struct estimator_parameters *parameters,
                              const struct estimator_constants *constants, enum joint i)
{
    scalar phi[THETA_H] = {0};
    scalar residual = -e->row_h[i][HYDRAULIC_COLUMNS].second;
    for (uint8_t k = 0; k < HYDRAULIC_COLUMNS; k++) {
        const uint8_t parameter = hydraulic_parameter[i][k];
        const scalar column = e->row_h[i][k].second;
        residual -= mul(column, e->theta_h[parameter]);
        phi[parameter] = mul(column, constants->scale_h[parameter]);
    }
    const variance innovation = update_block(&e->covariance_h, phi, constants->noise_h[i], residual,
                                             constants->scale_h, parameters->h, e->theta_h);
    if (absolute(residual) <= mul(parameters->innovation_limit, sd_of(innovation))) {
        e->strikes_h[i] = 0;
    } else if (e->strikes_h[i] < UINT8_MAX) {
        e->strikes_h[i]++;
    } else {
        /* enough */
    }
}

/* sat_M: the law's estimate follows by at most `step` a tick. */
static void rate_limit(scalar law[], const scalar theta[], const scalar step[], uint8_t size)
{
    for (uint8_t k = 0; k < size; k++) {
        law[k] += limit(theta[k] - law[k], -step[k], step[k]);
    }
}

void estimator_step(struct estimator *e, const struct estimator_parameters *parameters,
                    const struct estimator_constants *constants, const struct arm *arm,
                    const struct estimator_sample *sample)
{
    scalar half_w[JOINTS];
    for (uint8_t i = 0; i < JOINTS; i++) {
        half_w[i] = amp(constants->per_tick, sample->dq[i]);
    }
    if (e->samples >= 1u) {
        /* the mean of two instants is the half step's value to O((w dt)^2) */
        const struct wrist_trig half_trig = {
            .s = mul(SCALAR(0.5), e->previous.trig.s + sample->trig.s),
            .c = mul(SCALAR(0.5), e->previous.trig.c + sample->trig.c),
            .r = mul(SCALAR(0.5), e->previous.trig.r + sample->trig.r),
        };
        for (uint8_t i = 0; i < JOINTS; i++) {
            low_pass(&e->open[i], constants->filter, e->previous_gate[i]);
            mechanics_balance(e, constants, arm, (enum joint)i, &half_trig, half_w);
            hydraulics_balance(e, parameters, constants, (enum joint)i, half_w[i], sample);
        }
    }
    if (e->samples < 2u) {
        e->samples++;
    }
    for (uint8_t i = 0; i < JOINTS; i++) {
        e->previous_w[i] = half_w[i];
        e->previous_gate[i] = mul(e->ramp, gate(parameters, sample->reference_w[i]));
    }
    e->ramp = smaller(e->ramp + constants->filter, SCALAR(1));
    e->previous = *sample;

    const enum joint i = (enum joint)(e->turn % JOINTS);
    const bool mechanics = e->turn < JOINTS;
    e->turn = (uint8_t)((e->turn + 1u) % ROW_TURNS);
    e->since_update = e->since_update < ROW_TURNS ? (uint8_t)(e->since_update + 1u) : ROW_TURNS;
    if (e->open[i].second > LEAST_OPEN && !e->held) {
        if (mechanics) {
            update_mechanics(e, parameters, constants, i);
        } else {
            update_hydraulics(e, parameters, constants, i);
        }
        e->since_update = 0;
    }
    e->updating = e->since_update < ROW_TURNS;
    rate_limit(e->law_m, e->theta_m, constants->step_m, THETA_M);
    rate_limit(e->law_h, e->theta_h, constants->step_h, THETA_H);
}

scalar estimator_sd_m(const struct estimator *estimator, const struct estimator_constants *constants,
                      enum theta_m k)
{
    return mul(sd_of(ud_variance(&estimator->covariance_m, (uint8_t)k)), constants->scale_m[k]);
}

scalar estimator_sd_h(const struct estimator *estimator, const struct estimator_constants *constants,
                      enum theta_h k)
{
    return mul(sd_of(ud_variance(&estimator->covariance_h, (uint8_t)k)), constants->scale_h[k]);
}
