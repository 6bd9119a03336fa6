/* Covariance of a least-squares estimate as P = U D U' (Bierman): U unit upper triangular, D diagonal and
 * never negative, so P stays a covariance in short words too. */
#ifndef CONTROL_UD_FACTORS_H
#define CONTROL_UD_FACTORS_H

#include "control/scalar.h"

#define UD_SIZE_MAX 9
#define UD_OFF_DIAGONAL (UD_SIZE_MAX * (UD_SIZE_MAX - 1) / 2)

struct ud_factors {
    uint8_t size; /* 1..UD_SIZE_MAX */
    scalar D[UD_SIZE_MAX];
    scalar U[UD_OFF_DIAGONAL]; /* column by column above the diagonal: (0,1) (0,2) (1,2) (0,3) .. */
};

/* P = diag(variance); size 1..UD_SIZE_MAX. */
void ud_start(struct ud_factors *ud, uint8_t size, const scalar variance[]);

/* One scalar measurement y = phi' theta + noise of unit variance: P becomes the covariance after it, and
 * K (size entries) the gain, theta += K (y - phi' theta). Returns 1 + phi' P phi, the innovation's variance. */
scalar ud_update(struct ud_factors *ud, const scalar phi[], scalar K[]);

/* P(k,k). Adding x to D[0] adds x to P(0,0) alone, because U's first column is the unit vector. */
scalar ud_variance(const struct ud_factors *ud, uint8_t k);

#endif
