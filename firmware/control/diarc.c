#include "control/diarc.h"

static scalar symmetric_limit(scalar x, scalar bound)
{
    return limit(x, -bound, bound);
}

/* (gamma_M + |theta_max - theta_min| |phi|)^2 / (4 eta), Eq 22, but at most `most`. */
static scalar robust_gain(scalar bound, gain per_eta, scalar most)
{
    return smaller(amp(per_eta, mul(bound, bound)), most);
}

SELDOM struct diarc_constants diarc_constants(const struct diarc_gains *gains)
{
    return (struct diarc_constants){
        .per_eta1 = gain_quot(SCALAR(0.25), gains->eta1),
        .per_eta2 = gain_quot(SCALAR(0.25), gains->eta2),
    };
}

/* Everything of one tick that the state does not change. */
static struct diarc_steps two_steps(const struct diarc *diarc, const struct diarc_gains *gains,
                                    const struct diarc_constants *constants, const struct diarc_input *in,
                                    scalar ff_rate)
{
    const scalar R = in->cylinder.R;
    const scalar per_R = quot(SCALAR(1), R);
    const scalar H = in->H;
    struct diarc_steps s;

    /* step 1: torque */
    s.e2 = in->e1_rate + amp(gains->k1, in->e1); /* Eq 11 */
    const scalar k2s1 = robust_gain(gains->gamma1_max + in->torque_uncertainty, constants->per_eta1,
                                    amp(gains->k2s1_max, H)); /* Eq 22 */
    const scalar feedback = amp(gains->k2, mul(H, s.e2));
    s.F_Ld = mul(in->torque_ff - feedback - diarc->gamma1 - mul(k2s1, s.e2), per_R); /* Eq 14, 20 */

    /* F_Ld'_c: the feed-forward's difference, free of noise, and the feedback's analytic derivative with
     * H e2'^ from the model: H (q''^ - qd'') = R F - phi2' theta^ + gamma1. R' is left out: 0.1 % of it. */
    const scalar H_e2_rate =
        mul(R, in->force) - in->torque_ff + diarc->gamma1 + amp(gains->k1, mul(H, in->e1_rate));
    const scalar gamma1_rate = amp(gains->kappa1, mul(H, s.e2)); /* Eq 20 */
    const scalar compliance = mul(in->beta_inverse, per_R); /* as a factor of the terms it keeps them small */
    const scalar F_Ld_flow = mul(compliance, ff_rate - gamma1_rate) -
                             amp(gains->k2, mul(compliance, H_e2_rate)); /* theta_8 F_Ld'_c, Eq 17 */

    /* step 2: flow */
    s.e3 = in->force - s.F_Ld;
    const scalar w = in->reference_w + in->e1_rate;
    const scalar mu = -mul(gains->w1_over_w2, mul(R, s.e2)); /* Eq 18 */
    const scalar k2s2 =
        robust_gain(gains->gamma2_max + in->flow_uncertainty + mul(in->beta_share, absolute(F_Ld_flow)),
                    constants->per_eta2, amp(gains->k2s2_max, in->beta_inverse));
    /* Eq 18, 20: what the motion takes, less what the offsets give and the feedback asks */
    const scalar motion = add_limited(mul(in->cylinder.lamA, mul(R, w)), F_Ld_flow);
    const scalar offsets = add_limited(in->leakage - in->flow_offset, mu - diarc->gamma2);
    const scalar force_feedback = amp(gains->k3, mul(in->beta_inverse, s.e3)) + mul(k2s2, s.e3);
    s.Q_Ld = add_limited(add_limited(motion, offsets), -force_feedback);
    return s;
}

SELDOM void diarc_start(struct diarc *diarc, const struct diarc_gains *gains, const struct diarc_input *in)
{
    /* at rest on the reference F_Ld = (torque_ff - gamma1) / R, so this makes e3 = 0 */
    const scalar measured = mul(in->cylinder.R, in->force);
    *diarc = (struct diarc){
        .gamma1 = symmetric_limit(in->torque_ff - measured, gains->gamma1_max),
        .torque_ff = in->torque_ff,
        .started = true,
    };
}

struct diarc_steps diarc_flow(struct diarc *diarc, const struct diarc_gains *gains,
                              const struct diarc_constants *constants, const struct diarc_input *in,
                              gain per_tick)
{
    /* What the estimate took over, gamma1 gives back: adaptation alone moves no force. */
    diarc->gamma1 = symmetric_limit(diarc->gamma1 + in->torque_step, gains->gamma1_max);
    const scalar ff_before = diarc->torque_ff + in->torque_step;
    const scalar ff_rate = amp(per_tick, in->torque_ff - ff_before);
    diarc->torque_ff = in->torque_ff;
    return two_steps(diarc, gains, constants, in, ff_rate);
}

struct diarc_output diarc_opening(struct diarc *diarc, const struct diarc_gains *gains,
                                  const struct diarc_input *in, const struct diarc_steps *steps,
                                  scalar QL_gain, scalar dt_s)
{
    const scalar wanted = quot(steps->Q_Ld, QL_gain); /* Eq 7 */
    const scalar u = symmetric_limit(wanted, SCALAR(1));
    const bool saturated = u != wanted;

    /* gamma' = kappa e, integrated and then clamped, Eq 20 and 21; held while the valve cannot follow */
    if (!saturated) {
        diarc->gamma1 = symmetric_limit(diarc->gamma1 + mul(dt_s, amp(gains->kappa1, mul(in->H, steps->e2))),
                                        gains->gamma1_max);
        diarc->gamma2 =
            symmetric_limit(diarc->gamma2 + mul(dt_s, amp(gains->kappa2, mul(in->beta_inverse, steps->e3))),
                            gains->gamma2_max);
    }
    return (struct diarc_output){
        .u = u, .F_Ld = steps->F_Ld, .e2 = steps->e2, .e3 = steps->e3, .saturated = saturated};
}
