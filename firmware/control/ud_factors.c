#include "control/ud_factors.h"

/* Where column j of U begins. */
static uint8_t column(uint8_t j)
{
    return (uint8_t)(j * (j - 1) / 2);
}

void ud_start(struct ud_factors *ud, uint8_t size, const scalar variance[])
{
    *ud = (struct ud_factors){.size = size};
    for (uint8_t k = 0; k < size; k++) {
        ud->D[k] = variance[k];
    }
}

scalar ud_update(struct ud_factors *ud, const scalar phi[], scalar K[])
{
    scalar alpha = SCALAR(1); /* variance of the noise, then of the innovation as columns are added */
    scalar inverse_alpha = SCALAR(1);
    for (uint8_t j = 0; j < ud->size; j++) {
        scalar *const Uj = j > 0 ? &ud->U[column(j)] : ud->U;
        scalar f = phi[j]; /* f = U' phi */
        for (uint8_t i = 0; i < j; i++) {
            f += mul(Uj[i], phi[i]);
        }
        const scalar v = mul(ud->D[j], f); /* v = D f */
        const scalar previous_inverse = inverse_alpha;
        const scalar previous_alpha = alpha;
        alpha += mul(f, v);
        inverse_alpha = quot(SCALAR(1), alpha);
        ud->D[j] = mul(ud->D[j], mul(previous_alpha, inverse_alpha));
        const scalar lambda = -mul(f, previous_inverse);
        for (uint8_t i = 0; i < j; i++) {
            const scalar u = Uj[i];
            Uj[i] = u + mul(K[i], lambda);
            K[i] += mul(u, v);
        }
        K[j] = v;
    }
    for (uint8_t j = 0; j < ud->size; j++) {
        K[j] = mul(K[j], inverse_alpha);
    }
    return alpha;
}

scalar ud_variance(const struct ud_factors *ud, uint8_t k)
{
    scalar variance = ud->D[k];
    for (uint8_t j = (uint8_t)(k + 1); j < ud->size; j++) {
        const scalar u = ud->U[column(j) + k];
        variance += mul(mul(u, u), ud->D[j]);
    }
    return variance;
}
