/* Covariance of a least-squares estimate as P = U D U' (Bierman): U unit upper triangular, D diagonal and
 * never negative, so P stays a covariance in short words too.
 *
 * Scaling and overflow. Parameters are in units of their ranges and measurements per unit, so phi is of order one,
 * D at most 1 and, with the noise's variance as small as it is, K = P phi / alpha at most sqrt(D / noise) / 2. */
#ifndef CONTROL_UD_FACTORS_H
#define CONTROL_UD_FACTORS_H

#include "control/scalar.h"

#define UD_SIZE_MAX 9
#define UD_OFF_DIAGONAL (UD_SIZE_MAX * (UD_SIZE_MAX - 1) / 2)

struct ud_factors {
    uint8_t size; /* 1..UD_SIZE_MAX */
    variance D[UD_SIZE_MAX];
    scalar U[UD_OFF_DIAGONAL]; /* column by column above the diagonal: (0,1) (0,2) (1,2) (0,3) .. */
};

/* P = diag(prior); size 1..UD_SIZE_MAX. */
void ud_start(struct ud_factors *ud, uint8_t size, const variance prior[]);

/* One scalar measurement y = phi' theta + noise: P becomes the covariance after it, and K (size entries) the gain,
 * theta += K (y - phi' theta). Returns noise + phi' P phi, the innovation's variance. */
variance ud_update(struct ud_factors *ud, const scalar phi[], variance noise, gain K[]);

/* P(k,k). Adding x to D[0] adds x to P(0,0) alone, because U's first column is the unit vector. */
variance ud_variance(const struct ud_factors *ud, uint8_t k);

#endif
