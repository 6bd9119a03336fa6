#include "control/estimator.h"

/* An update needs the gate open over this much of the filter's window. */
#define LEAST_OPEN SCALAR(0.02)

/* This many innovations in a row that are too large mean a changed load. */
#define STRIKES 3

/* The load's variance grows in steps of this many updates: one update's share is too small for short words. */
#define WALK_UPDATES 50

static const uint8_t hydraulic_parameter[JOINTS][HYDRAULIC_COLUMNS] = {
    [SWING] = {BETA_INVERSE, OM2_SWING, OM3_SWING},
    [WRIST] = {BETA_INVERSE, OM2_WRIST, OM3_WRIST},
};

SELDOM void estimator_constants(struct estimator_constants *constants,
                                const struct estimator_parameters *parameters, scalar dt_s)
{
    const scalar window_s = mul(dt_s, SCALAR(ROW_TURNS));
    constants->filter = quot(window_s, parameters->filter_time + window_s);
    constants->filter_rate = gain_quot(constants->filter, window_s);
    constants->tick_filter = quot(dt_s, parameters->filter_time + dt_s);
    constants->tick_filter_rate = gain_quot(constants->tick_filter, dt_s);
    constants->per_tick = gain_quot(SCALAR(1), dt_s);
    constants->per_window = gain_quot(SCALAR(1), window_s);
    constants->per_gate_rate = gain_quot(SCALAR(1), parameters->gate_rate);
    for (uint8_t i = 0; i < JOINTS; i++) {
        constants->noise_m[i] = variance_of(parameters->torque_noise[i]);
        constants->noise_h[i] = variance_of(parameters->flow_noise[i]);
    }
    for (uint8_t k = 0; k < THETA_M; k++) {
        constants->scale_m[k] = parameters->m[k].high - parameters->m[k].low;
        constants->step_m[k] = mul(constants->scale_m[k], amp(parameters->rate_limit, dt_s));
    }
    for (uint8_t k = 0; k < THETA_H; k++) {
        constants->scale_h[k] = parameters->h[k].high - parameters->h[k].low;
        constants->step_h[k] = mul(constants->scale_h[k], amp(parameters->rate_limit, dt_s));
    }
    /* two updates, one per row of the mechanics, every ROW_TURNS ticks */
    const scalar walk_s = mul(dt_s, SCALAR(WALK_UPDATES * ROW_TURNS / 2));
    constants->walk =
        scale_variance(variance_of(quot(parameters->load_walk, constants->scale_m[M_T])), walk_s);
    constants->load_variance = variance_of(quot(parameters->m[M_T].sd, constants->scale_m[M_T]));
}

/* Commissioning knows a parameter to a quarter of its range. */
#define WIDE_SD SCALAR(0.25)

SELDOM static void start_covariance(const struct prior prior[], uint8_t size, const scalar scale[],
                                    struct ud_factors *covariance)
{
    variance P[UD_SIZE_MAX];
    for (uint8_t k = 0; k < size; k++) {
        P[k] = variance_of(quot(prior[k].sd, scale[k]));
    }
    ud_start(covariance, size, P);
}

SELDOM static void start_block(const struct prior prior[], uint8_t size, const scalar scale[], scalar theta[],
                               scalar law[], struct ud_factors *covariance)
{
    for (uint8_t k = 0; k < size; k++) {
        theta[k] = prior[k].value;
        law[k] = prior[k].value;
    }
    start_covariance(prior, size, scale, covariance);
}

SELDOM void estimator_start(struct estimator *estimator, const struct estimator_parameters *parameters,
                            const struct estimator_constants *constants)
{
    *estimator = (struct estimator){.since_update = ROW_TURNS}; /* as estimator_resume leaves it */
    start_block(parameters->m, THETA_M, constants->scale_m, estimator->theta_m, estimator->law_m,
                &estimator->covariance_m);
    start_block(parameters->h, THETA_H, constants->scale_h, estimator->theta_h, estimator->law_h,
                &estimator->covariance_h);
}

SELDOM void estimator_commission(struct estimator *estimator)
{
    variance open[UD_SIZE_MAX];
    for (uint8_t k = 0; k < UD_SIZE_MAX; k++) {
        open[k] = variance_of(WIDE_SD);
    }
    ud_start(&estimator->covariance_m, THETA_M, open);
    ud_start(&estimator->covariance_h, THETA_H, open);
    estimator->covariance_m.D[M_T] = VARIANCE(0);
    estimator->theta_m[M_T] = SCALAR(0);
    estimator->commissioning = true;
    estimator->follows_m = false;
    estimator_resume(estimator);
}

SELDOM void estimator_operate(struct estimator *estimator, const struct estimator_parameters *parameters,
                              const struct estimator_constants *constants)
{
    start_covariance(parameters->m, THETA_M, constants->scale_m, &estimator->covariance_m);
    start_covariance(parameters->h, THETA_H, constants->scale_h, &estimator->covariance_h);
    estimator->theta_m[M_T] = parameters->m[M_T].value;
    estimator->commissioning = false;
    estimator->follows_m = false;
    estimator_resume(estimator);
}

/* Empty filters; the balances go on from the samples that are there. */
SELDOM static void start_filters(struct estimator *estimator)
{
    for (uint8_t i = 0; i < JOINTS; i++) {
        struct mechanics *const m = &estimator->mechanics[i];
        struct hydraulics *const h = &estimator->hydraulics[i];
        for (uint8_t k = 0; k <= ROW_COLUMNS; k++) {
            m->column[k] = (struct two_poles){0};
            m->step[k] = SCALAR(0);
        }
        for (uint8_t k = 0; k <= HYDRAULIC_COLUMNS; k++) {
            h->column[k] = (struct two_poles){0};
        }
        m->open = (struct two_poles){0};
        h->step = SCALAR(0);
        m->gate = SCALAR(0);
        h->gate = SCALAR(0);
        m->strikes = 0;
        h->strikes = 0;
    }
    estimator->ramp = SCALAR(0);
}

SELDOM void estimator_resume(struct estimator *estimator)
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

/* The same of step / T + x, with pole_rate = pole_step / T. */
static void low_pass_rate(struct two_poles *filter, scalar *sum, scalar pole_step, gain pole_rate,
                          scalar step, scalar x)
{
    *sum += step - mul(pole_step, *sum);
    filter->first += mul(pole_step, x - filter->first);
    const scalar first = filter->first + amp(pole_rate, *sum);
    filter->second += mul(pole_step, first - filter->second);
}

/* 0 at rest, 1 from twice the gate's rate on; after a start of the filters it opens with the ramp. */
static scalar gate(const struct estimator *e, const struct estimator_parameters *parameters,
                   const struct estimator_constants *constants, scalar reference_w)
{
    const scalar excess = absolute(reference_w) - parameters->gate_rate;
    if (excess <= SCALAR(0)) {
        return SCALAR(0);
    }
    return mul(e->ramp, excess >= parameters->gate_rate ? SCALAR(1) : amp(constants->per_gate_rate, excess));
}

/* This tick's sample takes the place of the oldest. */
static void take_sample(struct estimator *e, const struct estimator_sample *sample)
{
    const scalar share = SCALAR(1.0 / ROW_TURNS);
    for (uint8_t i = 0; i < JOINTS; i++) {
        e->window.dq[i][e->turn] = sample->dq[i];
        e->window.torque[i][e->turn] = mul(share, mul(sample->cylinder[i].R, sample->force[i]));
        e->window.flow[i][e->turn] = mul(share, sample->flow[i]);
    }
}

_Static_assert(ROW_TURNS == 4, "sums of a window are written out");

scalar sum_of_window(const scalar sample[ROW_TURNS])
{
    return sample[0] + sample[1] + sample[2] + sample[3];
}

/* The same with the weights 1/4, 2/4, 3/4, 1, the newest last. */
static scalar rising_sum(const scalar sample[ROW_TURNS], uint8_t newest)
{
    wide sum = wide_of(sample[newest]);
    for (uint8_t n = 1; n < ROW_TURNS; n++) {
        sum = add_product(sum, SCALAR(1.0 / ROW_TURNS) * n, sample[(newest + n) % ROW_TURNS]);
    }
    return narrow(sum);
}

/* Momentum balance of joint i between the middles of the last two windows, gated and filtered, Eq 25. */
OWN_FRAME static void mechanics_balance(struct estimator *e, const struct estimator_parameters *parameters,
                                        const struct estimator_constants *constants, const struct arm *arm,
                                        enum joint i, const struct estimator_sample *now)
{
    struct mechanics *const m = &e->mechanics[i];
    const scalar half = SCALAR(0.5);
    const scalar w[JOINTS] = {amp(constants->per_window, sum_of_window(e->window.dq[SWING])),
                              amp(constants->per_window, sum_of_window(e->window.dq[WRIST]))};
    /* the mean of two instants is the value between them to O((w T)^2) */
    const struct wrist_trig middle = {
        .s = mul(half, m->trig.s + now->trig.s),
        .c = mul(half, m->trig.c + now->trig.c),
        .r = mul(half, m->trig.r + now->trig.r),
    };
    struct arm_row momentum;
    arm_momentum(arm, &middle, i, w, &momentum);
    const scalar rising = rising_sum(e->window.torque[i], e->turn);
    if (e->samples > 2u * ROW_TURNS) {
        const scalar between_w[JOINTS] = {mul(half, m->w[SWING] + w[SWING]),
                                          mul(half, m->w[WRIST] + w[WRIST])};
        struct arm_row force;
        arm_force(arm, &m->trig, i, between_w, m->friction_sign, m->lever, &force);
        const scalar torque = m->torque + sum_of_window(e->window.torque[i]) - rising;
        const struct arm_row *const before = &m->momentum;
        const scalar g = m->gate;
        low_pass(&m->open, constants->filter, g);
        for (uint8_t k = 0; k < ROW_COLUMNS; k++) {
            low_pass_rate(&m->column[k], &m->step[k], constants->filter, constants->filter_rate,
                          mul(g, momentum.phi[k] - before->phi[k]), mul(g, force.phi[k]));
        }
        low_pass_rate(&m->column[ROW_COLUMNS], &m->step[ROW_COLUMNS], constants->filter,
                      constants->filter_rate, mul(g, momentum.known - before->known),
                      mul(g, force.known - torque));
    }
    m->momentum = momentum;
    m->w[SWING] = w[SWING];
    m->w[WRIST] = w[WRIST];
    m->torque = rising;
    m->trig = now->trig;
    m->lever = now->lever[i];
    m->friction_sign = now->friction_sign[i];
    m->gate = gate(e, parameters, constants, now->reference_w[i]);
}

/* Flow balance of joint i over the last tick, gated and filtered: Eq 6 in the form of Eq 25. Every tick: 1/be shows in
 * what is fast, which a window would level. */
OWN_FRAME static void hydraulics_balance(struct estimator *e, const struct estimator_parameters *parameters,
                                         const struct estimator_constants *constants, enum joint i,
                                         const struct estimator_sample *now)
{
    struct hydraulics *const h = &e->hydraulics[i];
    const scalar half = SCALAR(0.5);
    const scalar filter = constants->tick_filter;
    const struct cylinder_state *const cylinder = &now->cylinder[i];
    const scalar lamA_R = mul(cylinder->lamA, cylinder->R);
    if (e->samples > 1u && h->gate > SCALAR(0)) {
        const scalar noise = parameters->flow_noise[i];
        const scalar g = mul(h->gate, quot(noise, noise + mul(parameters->flow_error, absolute(h->flow))));
        const scalar w = amp(constants->per_tick, now->dq[i]);
        const scalar displaced = mul(mul(half, h->lamA_R + lamA_R), w);
        const scalar flow = mul(half, h->flow + now->flow[i]);
        low_pass_rate(&h->column[0], &h->step, filter, constants->tick_filter_rate,
                      mul(g, now->force[i] - h->force), SCALAR(0));
        low_pass(&h->column[1], filter, -mul(g, mul(half, h->lamB + cylinder->lamB)));
        low_pass(&h->column[2], filter, -mul(g, mul(half, h->lamC + cylinder->lamC)));
        low_pass(&h->column[3], filter, mul(g, displaced - flow));
    } else {
        low_pass_rate(&h->column[0], &h->step, filter, constants->tick_filter_rate, SCALAR(0), SCALAR(0));
        for (uint8_t k = 1; k <= HYDRAULIC_COLUMNS; k++) {
            low_pass(&h->column[k], filter, SCALAR(0));
        }
    }
    h->lamA_R = lamA_R;
    h->lamB = cylinder->lamB;
    h->lamC = cylinder->lamC;
    h->force = now->force[i];
    h->flow = now->flow[i];
    h->gate = gate(e, parameters, constants, now->reference_w[i]);
}

/* The innovation test of the load: too large several times in a row, and the load alone is open again. */
static void notice_changed_load(struct estimator *e, const struct estimator_parameters *parameters,
                                const struct estimator_constants *constants, enum joint i, scalar residual,
                                variance innovation)
{
    if (absolute(residual) <= mul(parameters->innovation_limit, sd_of(innovation))) {
        e->mechanics[i].strikes = 0;
        return;
    }
    e->mechanics[i].strikes++;
    if (e->mechanics[i].strikes < STRIKES) {
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
    scalar residual = -e->mechanics[i].column[ROW_COLUMNS].second;
    for (uint8_t k = 0; k < ROW_COLUMNS; k++) {
        const uint8_t parameter = row_parameter(i, k);
        const scalar column = e->mechanics[i].column[k].second;
        residual -= mul(column, e->theta_m[parameter]);
        phi[parameter] = mul(column, constants->scale_m[parameter]);
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
    scalar residual = -e->hydraulics[i].column[HYDRAULIC_COLUMNS].second;
    for (uint8_t k = 0; k < HYDRAULIC_COLUMNS; k++) {
        const uint8_t parameter = hydraulic_parameter[i][k];
        const scalar column = e->hydraulics[i].column[k].second;
        residual -= mul(column, e->theta_h[parameter]);
        phi[parameter] = mul(column, constants->scale_h[parameter]);
    }
    const variance innovation = update_block(&e->covariance_h, phi, constants->noise_h[i], residual,
                                             constants->scale_h, parameters->h, e->theta_h);
    if (e->commissioning || absolute(residual) <= mul(parameters->innovation_limit, sd_of(innovation))) {
        e->hydraulics[i].strikes = 0; /* while the model is found out nothing contradicts it */
    } else if (e->hydraulics[i].strikes < UINT8_MAX) {
        e->hydraulics[i].strikes++;
    } else {
        /* enough */
    }
}

/* sat_M: the law's estimate follows by at most `step` a tick. True when it is there. */
static bool rate_limit(scalar law[], scalar moved[], const scalar theta[], const scalar step[], uint8_t size)
{
    bool there = true;
    for (uint8_t k = 0; k < size; k++) {
        const scalar change = theta[k] - law[k];
        if (absolute(change) <= step[k]) {
            moved[k] = change;
            law[k] = theta[k];
        } else {
            moved[k] = change > SCALAR(0) ? step[k] : -step[k];
            law[k] += moved[k];
            there = false;
        }
    }
    return there;
}

OWN_FRAME void estimator_step(struct estimator *e, const struct estimator_parameters *parameters,
                              const struct estimator_constants *constants, const struct arm *arm,
                              const struct estimator_sample *sample)
{
    if (e->samples <= 2u * ROW_TURNS) {
        e->samples++;
    }
    const enum joint i = (enum joint)(e->turn % JOINTS);
    const bool mechanics = e->turn < JOINTS;
    take_sample(e, sample);
    if (!mechanics) { /* the ticks without the mechanics' update, which takes longer than all other parts of a row */
        mechanics_balance(e, parameters, constants, arm, i, sample);
    }
    hydraulics_balance(e, parameters, constants, SWING, sample);
    hydraulics_balance(e, parameters, constants, WRIST, sample);
    e->ramp = smaller(e->ramp + constants->tick_filter, SCALAR(1));
    e->turn = (uint8_t)((e->turn + 1u) % ROW_TURNS);

    e->since_update = e->since_update < ROW_TURNS ? (uint8_t)(e->since_update + 1u) : ROW_TURNS;
    if (e->mechanics[i].open.second > LEAST_OPEN && !e->held) {
        if (mechanics) {
            update_mechanics(e, parameters, constants, i);
            e->follows_m = false;
        } else {
            update_hydraulics(e, parameters, constants, i);
            e->follows_h = false;
            if (!e->commissioning) {
                walk(
                    e,
                    constants); /* of the mechanics' estimate, as many as theirs, when there is time for it */
            }
        }
        e->since_update = 0;
    }
    e->updating = e->since_update < ROW_TURNS;
    e->law_m_moved = !e->follows_m;
    if (!e->follows_m) {
        e->follows_m = rate_limit(e->law_m, e->moved_m, e->theta_m, constants->step_m, THETA_M);
    }
    if (!e->follows_h) {
        scalar moved_h[THETA_H]; /* of no use: what the oil's parameters move is not given back */
        e->follows_h = rate_limit(e->law_h, moved_h, e->theta_h, constants->step_h, THETA_H);
    }
}

bool estimator_window_ended(const struct estimator *estimator, enum joint i)
{
    /* turn is that of the next tick; a joint's hydraulics come after the mechanics of both */
    return estimator->samples > 2u * ROW_TURNS &&
           estimator->turn == (uint8_t)((JOINTS + (uint8_t)i + 1u) % ROW_TURNS);
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
