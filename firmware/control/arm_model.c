#include "control/arm_model.h"

#define TWO_OVER_PI SCALAR(0.63661977236758134308)

struct wrist_trig wrist_trig(const struct arm *arm, scalar q2)
{
    const struct sine_cosine at = sine_cosine(q2);
    return (struct wrist_trig){.s = at.s, .c = at.c, .r = arm->L1 + mul(arm->L2, at.c)};
}

scalar coulomb_sign(const struct arm *arm, scalar w)
{
    return w == SCALAR(0) ? SCALAR(0) : mul(TWO_OVER_PI, arctangent(w, arm->coulomb_rate));
}

void arm_momentum(const struct arm *arm, const struct wrist_trig *t, enum joint i, const scalar w[JOINTS],
                  struct arm_row *row)
{
    row->phi[COL_FV] = SCALAR(0);
    row->phi[COL_FC] = SCALAR(0);
    row->phi[COL_OM] = SCALAR(0);
    if (i == SWING) { /* H11 q1', Eq 2 */
        row->phi[COL_M_T] = mul(mul(t->r, t->r), w[SWING]);
        row->phi[COL_J] = mul(mul(t->c, t->c), w[SWING]);
        row->phi[COL_M2] = mul(mul(arm->L1, t->r), w[SWING]);
        row->known = mul(arm->I1, w[SWING]);
    } else { /* H22 q2' */
        row->phi[COL_M_T] = mul(mul(arm->L2, arm->L2), w[WRIST]);
        row->phi[COL_J] = w[WRIST];
        row->phi[COL_M2] = SCALAR(0);
        row->known = SCALAR(0);
    }
}

/* -dH11/dq2 q1'^2/2 and gravity: the wrist row's terms that need no acceleration, Eq 3 and 4. */
static void wrist_centrifugal_and_gravity(const struct arm *arm, const struct wrist_trig *t, scalar w1,
                                          struct arm_row *row)
{
    const scalar w1_squared = mul(w1, w1);
    const scalar L2_s_w1_squared = mul(mul(arm->L2, t->s), w1_squared);
    const scalar g_L2_c = mul(mul(arm->g, arm->L2), t->c);
    row->phi[COL_M_T] += narrow(add_product(wide_of(g_L2_c), L2_s_w1_squared, t->r));
    row->phi[COL_J] += mul(mul(t->c, t->s), w1_squared);
    row->phi[COL_M2] += mul(SCALAR(0.5), narrow(add_product(wide_of(g_L2_c), L2_s_w1_squared, arm->L1)));
}

/* F = fv x' + fc s(x') at a lever arm: torque R F, with x' = R q'. */
static void friction_and_offset(scalar w, scalar sign, scalar lever, struct arm_row *row)
{
    row->phi[COL_FV] = mul(mul(lever, lever), w);
    row->phi[COL_FC] = mul(lever, sign);
    row->phi[COL_OM] = SCALAR(-1);
}

void arm_force(const struct arm *arm, const struct wrist_trig *t, enum joint i, const scalar w[JOINTS],
               scalar sign, scalar lever, struct arm_row *row)
{
    row->phi[COL_M_T] = SCALAR(0);
    row->phi[COL_J] = SCALAR(0);
    row->phi[COL_M2] = SCALAR(0);
    row->known = SCALAR(0);
    if (i == WRIST) {
        wrist_centrifugal_and_gravity(arm, t, w[SWING], row);
    }
    friction_and_offset(w[i], sign, lever, row);
}

void arm_inverse_dynamics(const struct arm *arm, const struct wrist_trig *t, enum joint i,
                          const scalar w[JOINTS], const scalar a[JOINTS], scalar sign, scalar lever,
                          struct arm_row *row)
{
    arm_momentum(arm, t, i, a, row); /* H is linear in the same columns: H q'' is the momentum of a */
    if (i == SWING) {                /* dH11/dq2 q1' q2', Eq 3 */
        const scalar s_w1_w2 = mul(t->s, mul(w[SWING], w[WRIST]));
        const scalar L2_s_w1_w2 = mul(arm->L2, s_w1_w2);
        row->phi[COL_M_T] -= mul(SCALAR(2), mul(L2_s_w1_w2, t->r));
        row->phi[COL_J] -= mul(SCALAR(2), mul(t->c, s_w1_w2));
        row->phi[COL_M2] -= mul(L2_s_w1_w2, arm->L1);
    } else {
        wrist_centrifugal_and_gravity(arm, t, w[SWING], row);
    }
    friction_and_offset(w[i], sign, lever, row);
}

scalar arm_row_torque(const struct arm_row *row, enum joint i, const scalar theta[THETA_M])
{
    wide torque = wide_of(row->known);
    for (uint8_t k = 0; k < ROW_COLUMNS; k++) {
        torque = add_product(torque, row->phi[k], theta[row_parameter(i, k)]);
    }
    return narrow(torque);
}

scalar arm_inertia(const struct arm *arm, const struct wrist_trig *t, enum joint i,
                   const scalar theta[THETA_M])
{
    wide H;
    if (i == SWING) {
        H = add_product(wide_of(arm->I1), theta[M2], mul(arm->L1, t->r));
        H = add_product(H, theta[J], mul(t->c, t->c));
        H = add_product(H, theta[M_T], mul(t->r, t->r));
    } else {
        H = add_product(wide_of(theta[J]), theta[M_T], mul(arm->L2, arm->L2));
    }
    return narrow(H);
}
