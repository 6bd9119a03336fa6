#include "control/controller.h"

struct controller_constants controller_constants(const struct machine *machine, scalar dt_s)
{
    struct controller_constants constants = {.dt_s = dt_s};
    for (uint8_t i = 0; i < JOINTS; i++) {
        constants.cylinder[i] = cylinder_constants(&machine->cylinder[i]);
    }
    constants.observer = observer_constants(machine->observer_bandwidth, dt_s);
    constants.estimator = estimator_constants(&machine->estimator, dt_s);
    return constants;
}

void controller_start(struct controller *controller, const struct machine *machine,
                      const struct controller_constants *constants)
{
    *controller = (struct controller){.kind = CONTROLLER_DIARC};
    estimator_start(&controller->estimator, &machine->estimator, &constants->estimator);
}

void controller_arm(struct controller *controller, enum controller_kind kind, const scalar q[JOINTS])
{
    controller->kind = kind;
    controller->armed = true;
    for (uint8_t i = 0; i < JOINTS; i++) {
        controller->trajectory[i] = trajectory_at_rest(q[i]);
        controller->observer[i] = observer_at(SCALAR(0));
        controller->diarc[i] = (struct diarc){0};
        controller->pid[i] = (struct pid){0};
    }
}

void controller_disarm(struct controller *controller)
{
    controller->armed = false;
    for (uint8_t i = 0; i < JOINTS; i++) {
        controller->output[i] = (struct joint_output){0};
    }
}

void controller_gap(struct controller *controller)
{
    estimator_resume(&controller->estimator);
}

/* The law's parameters: the estimate, or the estimate without its load. */
static void law_parameters(const struct controller *controller, scalar theta[THETA_M])
{
    for (uint8_t k = 0; k < THETA_M; k++) {
        theta[k] = controller->estimator.law_m[k];
    }
    if (controller->kind != CONTROLLER_DIARC) {
        theta[M_T] = SCALAR(0);
    }
}

/* What estimator and law both need of a joint's valve and cylinder; its roots are taken once. */
struct joint_flow {
    scalar gain_extending; /* QL per unit opening */
    scalar gain_retracting;
    scalar leakage; /* m^2/s */
};

static struct joint_flow joint_flow(const struct machine *machine, enum joint i,
                                    const struct cylinder_state *state, const scalar p[CHAMBERS])
{
    const struct cylinder *const cylinder = &machine->cylinder[i];
    return (struct joint_flow){
        .gain_extending = valve_gain(cylinder, &machine->supply, state, p, true),
        .gain_retracting = valve_gain(cylinder, &machine->supply, state, p, false),
        .leakage = cylinder_leakage(cylinder, state, p),
    };
}

static void estimate(struct controller *controller, const struct machine *machine,
                     const struct controller_constants *constants, const struct measurement *measured,
                     struct estimator_sample *sample, struct joint_flow flow[JOINTS])
{
    sample->trig = wrist_trig(&machine->arm, measured->q[WRIST]);
    for (uint8_t i = 0; i < JOINTS; i++) {
        const struct cylinder *const cylinder = &machine->cylinder[i];
        const scalar *const p = measured->p[i];
        sample->dq[i] = measured->dq[i];
        sample->reference_w[i] = controller->output[i].reference.w;
        sample->cylinder[i] = cylinder_at(cylinder, &constants->cylinder[i], measured->q[i]);
        sample->force[i] = cylinder_force(&constants->cylinder[i], p);
        sample->lever[i] = machine->arm.friction_at_cylinder > SCALAR(0.5)
                               ? mul(sample->cylinder[i].R, constants->cylinder[i].lever_inverse)
                               : SCALAR(1);
        const scalar opening = valve_opening(cylinder, measured->spool[i]);
        flow[i] = joint_flow(machine, (enum joint)i, &sample->cylinder[i], p);
        const scalar valve = opening >= SCALAR(0) ? flow[i].gain_extending : flow[i].gain_retracting;
        sample->flow[i] = mul(opening, valve) - flow[i].leakage;
    }
    estimator_step(&controller->estimator, &machine->estimator, &constants->estimator, &machine->arm, sample);
}

/* |theta_max - theta_min| |phi|, of what the law takes from the estimate. */
static scalar torque_uncertainty(const struct estimator_constants *constants, const struct arm_row *row,
                                 enum joint i)
{
    scalar sum = SCALAR(0);
    for (uint8_t k = 0; k < ROW_COLUMNS; k++) {
        sum = add_limited(sum, mul(constants->scale_m[row_parameter[i][k]], absolute(row->phi[k])));
    }
    return sum;
}

static scalar diarc_joint(struct controller *controller, const struct machine *machine,
                          const struct controller_constants *constants, const struct estimator_sample *sample,
                          const struct joint_flow *flow, enum joint i, const scalar theta[THETA_M],
                          const struct wrist_trig *desired, struct joint_output *out)
{
    const scalar w[JOINTS] = {controller->output[SWING].reference.w, controller->output[WRIST].reference.w};
    const scalar a[JOINTS] = {controller->output[SWING].reference.a, controller->output[WRIST].reference.a};
    const struct estimator_constants *const ranges = &constants->estimator;
    const scalar *const theta_h = controller->estimator.law_h;
    const struct cylinder_state *const c = &sample->cylinder[i];
    const enum theta_h om2 = i == SWING ? OM2_SWING : OM2_WRIST;
    const enum theta_h om3 = i == SWING ? OM3_SWING : OM3_WRIST;

    struct arm_row phi2;
    arm_inverse_dynamics(&machine->arm, desired, i, w, a, sample->lever[i], &phi2);
    scalar torque_step = SCALAR(0);
    for (uint8_t k = 0; k < ROW_COLUMNS; k++) {
        const uint8_t parameter = row_parameter[i][k];
        torque_step = add_limited(torque_step,
                                  mul(phi2.phi[k], theta[parameter] - controller->law_m_before[parameter]));
    }
    const struct diarc_input in = {
        .e1 = out->e1,
        .e1_rate = out->e1_rate,
        .reference_w = w[i],
        .torque_ff = arm_row_torque(&phi2, i, theta),
        .torque_uncertainty = torque_uncertainty(ranges, &phi2, i),
        .torque_step = torque_step,
        .H = arm_inertia(&machine->arm, desired, i, theta),
        .beta_inverse = theta_h[BETA_INVERSE],
        .beta_uncertainty = ranges->scale_h[BETA_INVERSE],
        .flow_offset = mul(c->lamB, theta_h[om2]) + mul(c->lamC, theta_h[om3]),
        .flow_uncertainty = mul(c->lamB, ranges->scale_h[om2]) + mul(c->lamC, ranges->scale_h[om3]),
        .cylinder = *c,
        .force = sample->force[i],
        .leakage = flow->leakage,
        .gain_extending = flow->gain_extending,
        .gain_retracting = flow->gain_retracting,
    };
    if (!controller->diarc[i].started) {
        diarc_start(&controller->diarc[i], &machine->diarc[i], &in);
    }
    const struct diarc_output output = diarc_step(&controller->diarc[i], &machine->diarc[i], &in,
                                                  constants->dt_s, constants->estimator.per_tick);
    out->saturated = output.saturated;
    return output.u;
}

void controller_step(struct controller *controller, const struct machine *machine,
                     const struct controller_constants *constants, const struct measurement *measured)
{
    for (uint8_t i = 0; i < JOINTS; i++) {
        struct joint_output *const out = &controller->output[i];
        if (!controller->armed) {
            out->reference = (struct reference){.q = measured->q[i]};
            continue;
        }
        out->reference = trajectory_now(&controller->trajectory[i]);
        out->e1 = measured->q[i] - out->reference.q;
        observer_step(&controller->observer[i], &constants->observer, out->e1, constants->dt_s);
        out->e1_rate = controller->observer[i].w;
    }

    struct estimator_sample sample;
    struct joint_flow flow[JOINTS];
    estimate(controller, machine, constants, measured, &sample, flow);
    if (!controller->armed) {
        return;
    }

    scalar theta[THETA_M];
    law_parameters(controller, theta);
    const struct wrist_trig desired = wrist_trig(&machine->arm, controller->output[WRIST].reference.q);
    for (uint8_t i = 0; i < JOINTS; i++) {
        struct joint_output *const out = &controller->output[i];
        if (controller->kind == CONTROLLER_PID) {
            out->u = pid_step(&controller->pid[i], &machine->pid[i], out->e1, out->e1_rate, constants->dt_s);
        } else {
            const bool first = !controller->diarc[i].started;
            if (first) { /* no step of the estimate before the first tick */
                for (uint8_t k = 0; k < THETA_M; k++) {
                    controller->law_m_before[k] = theta[k];
                }
            }
            out->u = diarc_joint(controller, machine, constants, &sample, &flow[i], (enum joint)i, theta,
                                 &desired, out);
        }
        /* DIARC's set-point leads by a share of the spool's measured lag */
        const scalar share = controller->kind == CONTROLLER_PID ? SCALAR(0) : machine->diarc[i].spool_lead;
        const scalar spool = valve_spool(&machine->cylinder[i], out->u);
        out->u = limit(spool + mul(share, spool - measured->spool[i]), SCALAR(-1), SCALAR(1));
        trajectory_advance(&controller->trajectory[i], constants->dt_s);
    }
    for (uint8_t k = 0; k < THETA_M; k++) {
        controller->law_m_before[k] = theta[k];
    }
}
