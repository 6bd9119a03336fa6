/* The two-link arm: swing about a vertical axis, wrist in pitch, the load a point mass at the wrist's tip.
 *
 *     row 1:  d/dt( H11 q1' )                    + fv1 q1' + fc1 s(q1') - Om1 = R1 F1
 *     row 2:  d/dt( H22 q2' ) - dH11/dq2 q1'^2/2 + g L2 c (m2/2 + m_t)
 *                                                + fv2 q2' + fc2 s(q2') - Om2 = R2 F2        (Eq 1 to 4)
 *
 *     H11 = I1 + m2 L1 r + J c^2 + m_t r^2,  H22 = J + m_t L2^2,  r = L1 + L2 c,  c = cos q2, s = sin q2
 *
 * Both rows are linear in theta_m = [m_t J m2 fv1 fv2 fc1 fc2 Om1 Om2]: (Eq 10). Each row holds six of the
 * nine; a "row" below has only those six columns, and row_parameter() says which they are. Where the printed
 * equations differ from these, and why these are right: docs/paper.md. */
#ifndef CONTROL_ARM_MODEL_H
#define CONTROL_ARM_MODEL_H

#include "control/scalar.h"

enum joint { SWING, WRIST, JOINTS };

/* theta_m, Eq 10. The load comes first: the estimator relies on it. */
enum theta_m { M_T, J, M2, FV1, FV2, FC1, FC2, OM1, OM2, THETA_M };

/* Columns of one row. */
enum row_column { COL_M_T, COL_J, COL_M2, COL_FV, COL_FC, COL_OM, ROW_COLUMNS };

/* Which of theta column k of joint i's row belongs to. By arithmetic, not by a table: where a loop over the columns is
 * unrolled it costs nothing. */
static inline uint8_t row_parameter(enum joint i, uint8_t k)
{
    return k < COL_FV ? k : (uint8_t)(2u * k - COL_FV + (uint8_t)i);
}

_Static_assert((int)M_T == (int)COL_M_T && (int)J == (int)COL_J && (int)M2 == (int)COL_M2,
               "both joints have the first three");
_Static_assert((int)FV1 == (int)COL_FV && FV2 == FV1 + 1 && FC1 == FV1 + 2 && OM1 == FV1 + 4,
               "of the others each has one of a pair");

/* What of the arm is known for good. */
struct arm {
    scalar L1;                   /* swing link, axis to wrist, m */
    scalar L2;                   /* wrist link, axis to tip, m */
    scalar I1;                   /* swing inertia about its axis, kg m^2 */
    scalar g;                    /* gravity, m/s^2 */
    scalar coulomb_rate;         /* s(w) = (2/pi) atan(w / rate), rad/s */
    scalar friction_at_cylinder; /* 0: at the joint; 1: at the cylinder, torques given at q = 0 */
};

/* Wrist angle's functions, computed once and shared. */
struct wrist_trig {
    scalar s; /* sin q2 */
    scalar c; /* cos q2 */
    scalar r; /* L1 + L2 c: swing axis to tip, m */
};

/* A row of the regression: phi' theta + known = torque. */
struct arm_row {
    scalar phi[ROW_COLUMNS];
    scalar known;
};

/* q2 in rad, |q2| <= pi. */
struct wrist_trig wrist_trig(const struct arm *arm, scalar q2);

/* s(w), the smooth sign of friction, -1..1; w in rad/s. */
scalar coulomb_sign(const struct arm *arm, scalar w);

/* Momentum of joint i, row of H(q) q' : columns M_T, J, M2 and known are set, the others are zero. */
void arm_momentum(const struct arm *arm, const struct wrist_trig *t, enum joint i, const scalar w[JOINTS],
                  struct arm_row *row);

/* All terms of row i but the momentum's rate and R F: Coriolis and gravity, friction, offset.
 * sign is coulomb_sign of the speed that friction is taken of; lever, the lever arm over that at q = 0, where
 * friction acts at the cylinder, else 1. */
void arm_force(const struct arm *arm, const struct wrist_trig *t, enum joint i, const scalar w[JOINTS],
               scalar sign, scalar lever, struct arm_row *row);

/* phi2(q, q', q''), Eq 14: row i of the inverse dynamics; phi' theta + known = R F. a in rad/s^2;
 * sign and lever as above, sign of w[i]. */
void arm_inverse_dynamics(const struct arm *arm, const struct wrist_trig *t, enum joint i,
                          const scalar w[JOINTS], const scalar a[JOINTS], scalar sign, scalar lever,
                          struct arm_row *row);

/* phi' theta + known, N m per unit. */
scalar arm_row_torque(const struct arm_row *row, enum joint i, const scalar theta[THETA_M]);

/* H_ii, kg m^2 per unit. */
scalar arm_inertia(const struct arm *arm, const struct wrist_trig *t, enum joint i,
                   const scalar theta[THETA_M]);

#endif
