#include "control/controller.h"

SELDOM void controller_constants(struct controller_constants *constants, const struct machine *machine,
                                 scalar dt_s)
{
    constants->dt_s = dt_s;
    for (uint8_t i = 0; i < JOINTS; i++) {
        constants->cylinder[i] = cylinder_constants(&machine->cylinder[i]);
        constants->diarc[i] = diarc_constants(&machine->diarc[i]);
    }
    constants->observer = observer_constants(machine->observer_bandwidth, dt_s);
    estimator_constants(&constants->estimator, &machine->estimator, dt_s);
}

SELDOM void controller_arm(struct controller *controller, enum controller_kind kind, const scalar q[JOINTS])
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

SELDOM void controller_start(struct controller *controller, const struct machine *machine,
                             const struct controller_constants *constants)
{
    /* not as a whole: the estimate, most of it, clears itself */
    const scalar rest[JOINTS] = {SCALAR(0), SCALAR(0)};
    controller_arm(controller, CONTROLLER_DIARC, rest);
    controller_disarm(controller);
    estimator_start(&controller->estimator, &machine->estimator, &constants->estimator);
}

void controller_gap(struct controller *controller)
{
    estimator_resume(&controller->estimator);
}

/* What estimator and law both need of a joint's valve and cylinder; its roots are taken once where both look at the
 * same side of the valve, as they mostly do. */
struct joint_flow {
    bool extending; /* the side that is open */
    scalar gain;    /* QL per unit opening to that side */
    scalar leakage; /* m^2/s */
};

static struct joint_flow joint_flow(const struct machine *machine, enum joint i,
                                    const struct cylinder_state *state, const scalar p[CHAMBERS],
                                    bool extending)
{
    const struct cylinder *const cylinder = &machine->cylinder[i];
    return (struct joint_flow){
        .extending = extending,
        .gain = valve_gain(cylinder, &machine->supply, state, p, extending),
        .leakage = cylinder_leakage(cylinder, state, p),
    };
}

OWN_FRAME static void take_sample(const struct controller *controller, const struct machine *machine,
                                  const struct controller_constants *constants,
                                  const struct measurement *measured, struct estimator_sample *sample,
                                  struct joint_flow flow[JOINTS])
{
    sample->trig = wrist_trig(&machine->arm, measured->q[WRIST]);
    for (uint8_t i = 0; i < JOINTS; i++) {
        const struct cylinder *const cylinder = &machine->cylinder[i];
        const scalar *const p = measured->p[i];
        sample->dq[i] = measured->dq[i];
        sample->reference_w[i] = controller->output[i].reference.w;
        sample->friction_sign[i] = coulomb_sign(&machine->arm, sample->reference_w[i]);
        sample->cylinder[i] = cylinder_at(cylinder, &constants->cylinder[i], measured->q[i]);
        sample->force[i] = cylinder_force(&constants->cylinder[i], p);
        sample->lever[i] = machine->arm.friction_at_cylinder > SCALAR(0.5)
                               ? mul(sample->cylinder[i].R, constants->cylinder[i].lever_inverse)
                               : SCALAR(1);
        const scalar opening = valve_opening(cylinder, measured->spool[i]);
        flow[i] = joint_flow(machine, (enum joint)i, &sample->cylinder[i], p, opening >= SCALAR(0));
        sample->flow[i] = mul(opening, flow[i].gain) - flow[i].leakage;
    }
}

/* What the law takes from the estimate through one row. */
struct row_torques {
    scalar torque;      /* phi' theta + known */
    scalar uncertainty; /* |theta_max - theta_min| |phi| */
};

static struct row_torques row_torques(const struct arm_row *row, enum joint i, const scalar theta[THETA_M],
                                      const scalar range[THETA_M])
{
    wide torque = wide_of(row->known);
    wide uncertainty = wide_of(SCALAR(0));
    UNROLL_SHORT_LOOP
    for (uint8_t k = 0; k < ROW_COLUMNS; k++) {
        const uint8_t parameter = row_parameter(i, k);
        const scalar phi = row->phi[k];
        torque = add_product(torque, phi, theta[parameter]);
        uncertainty = add_product(uncertainty, absolute(phi), range[parameter]);
    }
    return (struct row_torques){narrow(torque), narrow(uncertainty)};
}

/* phi' (theta - before), by how much the estimate moved the torque. */
static scalar torque_step(const struct controller *controller, const struct arm_row *row, enum joint i)
{
    const struct estimator *const e = &controller->estimator;
    wide step = wide_of(SCALAR(0));
    if (!e->law_m_moved || !controller->diarc[i].started) {
        return SCALAR(0); /* before the first tick there is none */
    }
    UNROLL_SHORT_LOOP
    for (uint8_t k = 0; k < ROW_COLUMNS; k++) {
        if (k > (uint8_t)COL_M_T || controller->kind == CONTROLLER_DIARC) {
            step = add_product(step, row->phi[k], e->moved_m[row_parameter(i, k)]);
        }
    }
    return narrow(step);
}

static scalar diarc_joint(struct controller *controller, const struct machine *machine,
                          const struct controller_constants *constants, const struct estimator_sample *sample,
                          const struct joint_flow *flow, const scalar p[CHAMBERS], enum joint i,
                          const scalar theta[THETA_M], const struct wrist_trig *desired, scalar beta_share,
                          struct joint_output *out)
{
    const scalar w[JOINTS] = {controller->output[SWING].reference.w, controller->output[WRIST].reference.w};
    const scalar a[JOINTS] = {controller->output[SWING].reference.a, controller->output[WRIST].reference.a};
    const struct estimator_constants *const ranges = &constants->estimator;
    const scalar *const theta_h = controller->estimator.law_h;
    const struct cylinder_state *const c = &sample->cylinder[i];
    const enum theta_h om2 = i == SWING ? OM2_SWING : OM2_WRIST;
    const enum theta_h om3 = i == SWING ? OM3_SWING : OM3_WRIST;

    struct arm_row phi2;
    arm_inverse_dynamics(&machine->arm, desired, i, w, a, sample->friction_sign[i], sample->lever[i], &phi2);
    const struct row_torques torques = row_torques(&phi2, i, theta, ranges->scale_m);
    const struct diarc_input in = {
        .e1 = out->e1,
        .e1_rate = out->e1_rate,
        .reference_w = w[i],
        .torque_ff = torques.torque,
        .torque_uncertainty = torques.uncertainty,
        .torque_step = torque_step(controller, &phi2, i),
        .H = arm_inertia(&machine->arm, desired, i, theta),
        .beta_inverse = theta_h[BETA_INVERSE],
        .beta_share = beta_share,
        .flow_offset = mul(c->lamB, theta_h[om2]) + mul(c->lamC, theta_h[om3]),
        .flow_uncertainty = mul(c->lamB, ranges->scale_h[om2]) + mul(c->lamC, ranges->scale_h[om3]),
        .cylinder = *c,
        .force = sample->force[i],
        .leakage = flow->leakage,
    };
    if (!controller->diarc[i].started) {
        diarc_start(&controller->diarc[i], &machine->diarc[i], &in);
    }
    const struct diarc_gains *const gains = &machine->diarc[i];
    const struct diarc_steps steps =
        diarc_flow(&controller->diarc[i], gains, &constants->diarc[i], &in, constants->estimator.per_tick);
    const bool extend = steps.Q_Ld >= SCALAR(0);
    const scalar QL_gain = extend == flow->extending
                               ? flow->gain
                               : valve_gain(&machine->cylinder[i], &machine->supply, c, p, extend);
    const struct diarc_output output =
        diarc_opening(&controller->diarc[i], gains, &in, &steps, QL_gain, constants->dt_s);
    out->saturated = output.saturated;
    return output.u;
}

/* Reference, and the error from it. */
static void follow_reference(struct controller *controller, const struct controller_constants *constants,
                             const struct measurement *measured)
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
}

static void pid_law(struct controller *controller, const struct machine *machine,
                    const struct controller_constants *constants)
{
    for (uint8_t i = 0; i < JOINTS; i++) {
        struct joint_output *const out = &controller->output[i];
        const scalar u =
            pid_step(&controller->pid[i], &machine->pid[i], out->e1, out->e1_rate, constants->dt_s);
        out->u = limit(valve_spool(&machine->cylinder[i], u), SCALAR(-1), SCALAR(1));
    }
}

OWN_FRAME static void diarc_law(struct controller *controller, const struct machine *machine,
                                const struct controller_constants *constants,
                                const struct measurement *measured, const struct estimator_sample *sample,
                                const struct joint_flow flow[JOINTS])
{
    const scalar *theta = controller->estimator.law_m;
    scalar without_load[THETA_M];
    if (controller->kind != CONTROLLER_DIARC) {
        for (uint8_t k = 0; k < THETA_M; k++) {
            without_load[k] = theta[k];
        }
        without_load[M_T] = SCALAR(0);
        theta = without_load;
    }
    const struct wrist_trig desired = wrist_trig(&machine->arm, controller->output[WRIST].reference.q);
    const scalar beta_share =
        quot(constants->estimator.scale_h[BETA_INVERSE], controller->estimator.law_h[BETA_INVERSE]);
    for (uint8_t i = 0; i < JOINTS; i++) {
        struct joint_output *const out = &controller->output[i];
        const scalar u = diarc_joint(controller, machine, constants, sample, &flow[i], measured->p[i],
                                     (enum joint)i, theta, &desired, beta_share, out);
        /* the set-point leads by a share of the spool's measured lag */
        const scalar spool = valve_spool(&machine->cylinder[i], u);
        const scalar lead = mul(machine->diarc[i].spool_lead, spool - measured->spool[i]);
        out->u = limit(spool + lead, SCALAR(-1), SCALAR(1));
    }
}

OWN_FRAME void controller_step(struct controller *controller, const struct machine *machine,
                               const struct controller_constants *constants,
                               const struct measurement *measured)
{
    struct estimator_sample sample;
    struct joint_flow flow[JOINTS];
    follow_reference(controller, constants, measured);
    take_sample(controller, machine, constants, measured, &sample, flow);
    estimator_step(&controller->estimator, &machine->estimator, &constants->estimator, &machine->arm,
                   &sample);
    if (!controller->armed) {
        return;
    }
    if (controller->kind == CONTROLLER_PID) {
        pid_law(controller, machine, constants);
    } else {
        diarc_law(controller, machine, constants, measured, &sample, flow);
    }
    for (uint8_t i = 0; i < JOINTS; i++) {
        trajectory_advance(&controller->trajectory[i], constants->dt_s);
    }
}
