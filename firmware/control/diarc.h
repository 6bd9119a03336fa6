/* The direct half of DIARC: backstepping in two steps for one joint, Eq 11 to 22. Fast dynamic compensation
 * (gamma) takes what the estimate leaves; the robust terms bound what neither knows. */
#ifndef CONTROL_DIARC_H
#define CONTROL_DIARC_H

#include "control/arm_model.h"
#include "control/hydraulics.h"

struct diarc_gains {
    gain k1;           /* 1/s */
    gain k2;           /* 1/s, times H */
    gain k3;           /* 1/s, times 1/be */
    gain kappa1;       /* fast compensation of torque, 1/s^2, times H */
    gain kappa2;       /* fast compensation of flow, 1/s^2, times 1/be */
    scalar w1_over_w2; /* weight of mu, m */
    scalar eta1;       /* how much error the robust term of step 1 lets through, N m rad/s */
    scalar eta2;       /* the same of step 2, N m^2/s */
    gain k2s1_max;     /* bound of the robust gain of step 1, 1/s times H */
    gain k2s2_max;     /* bound of the robust gain of step 2, 1/s times 1/be */
    scalar gamma1_max; /* gamma_M of torque, N m */
    scalar gamma2_max; /* gamma_M of flow, m^2/s */
    scalar spool_lead; /* share of the spool's lag behind its set-point that is added to it */
};

/* What follows from them once. */
struct diarc_constants {
    gain per_eta1, per_eta2; /* 1 / (4 eta) */
};

/* What one joint's law sees at one tick. */
struct diarc_input {
    scalar e1;                 /* q - qd, rad */
    scalar e1_rate;            /* e1', rad/s */
    scalar reference_w;        /* qd', rad/s */
    scalar torque_ff;          /* phi2(qd, qd', qd'')' theta^, N m */
    scalar torque_uncertainty; /* |theta_max - theta_min| |phi2|, N m */
    scalar torque_step;        /* phi2' (theta^_k - theta^_(k-1)): by how much the estimate moved torque_ff */
    scalar H;                  /* inertia at theta^, kg m^2 */
    scalar beta_inverse;       /* theta_8 = 1/be^ */
    scalar beta_share;         /* theta_8's range over theta_8 */
    scalar flow_offset;        /* d^ = lamB Om2^ + lamC Om3^, m^2/s */
    scalar flow_uncertainty;   /* |d_max - d_min|, m^2/s */
    struct cylinder_state cylinder;
    scalar force;   /* F, N */
    scalar leakage; /* m^2/s */
};

/* Both steps' results; Q_Ld is what the valve is to pass, m^2/s. */
struct diarc_steps {
    scalar e2, F_Ld, e3, Q_Ld;
};

struct diarc {
    scalar gamma1;    /* N m */
    scalar gamma2;    /* m^2/s */
    scalar torque_ff; /* of the tick before */
    bool started;
};

/* Intermediate results, for people and tests. */
struct diarc_output {
    scalar u;    /* spool set-point, -1..1 */
    scalar F_Ld; /* desired force, N */
    scalar e2;   /* rad/s */
    scalar e3;   /* N */
    bool saturated;
};

struct diarc_constants diarc_constants(const struct diarc_gains *gains);

/* Bumpless start: gamma1 such that F_Ld is the measured force. gamma2 starts at zero: what the valve then
 * passes at rest is the leakage. */
void diarc_start(struct diarc *diarc, const struct diarc_gains *gains, const struct diarc_input *in);

/* One tick of dt_s in two parts, because the valve's gain depends on which way the flow is wanted: the flow, per_tick =
 * 1 / dt_s, and then the set-point that QL_gain, QL per unit opening to that side, makes of it. */
struct diarc_steps diarc_flow(struct diarc *diarc, const struct diarc_gains *gains,
                              const struct diarc_constants *constants, const struct diarc_input *in,
                              gain per_tick);
struct diarc_output diarc_opening(struct diarc *diarc, const struct diarc_gains *gains,
                                  const struct diarc_input *in, const struct diarc_steps *steps,
                                  scalar QL_gain, scalar dt_s);

#endif
