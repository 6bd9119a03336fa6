#include "control/ud_factors.h"

/* Where column j of U begins. */
static uint8_t column(uint8_t j)
{
    return (uint8_t)(j * (j - 1) / 2);
}

void ud_start(struct ud_factors *ud, uint8_t size, const variance prior[])
{
    *ud = (struct ud_factors){.size = size};
    for (uint8_t k = 0; k < size; k++) {
        ud->D[k] = prior[k];
    }
}

variance ud_update(struct ud_factors *ud, const scalar phi[], variance noise, gain K[])
{
    variance P_phi[UD_SIZE_MAX];
    variance alpha = noise; /* variance of the noise, then of the innovation as columns are added */
    inverse alpha_inverse = invert(alpha);
    for (uint8_t j = 0; j < ud->size; j++) {
        scalar *const Uj = j > 0 ? &ud->U[column(j)] : ud->U;
        scalar f = phi[j]; /* f = U' phi */
        for (uint8_t i = 0; i < j; i++) {
            f = add_limited(f, mul(Uj[i], phi[i]));
        }
        const variance v = scale_variance(ud->D[j], f); /* v = D f */
        const variance alpha_before = alpha;
        alpha = add_variance(alpha, scale_variance(v, f));
        for (uint8_t i = 0; i < j; i++) {
            const scalar u = Uj[i];
            Uj[i] = add_limited(u, -amp(variance_ratio(P_phi[i], alpha_inverse), f));
            P_phi[i] = add_variance(P_phi[i], scale_variance(v, u));
        }
        P_phi[j] = v;
        alpha_inverse = invert(alpha);
        ud->D[j] = scale_variance(ud->D[j], variance_share(alpha_before, alpha_inverse));
    }
    for (uint8_t j = 0; j < ud->size; j++) {
        K[j] = variance_ratio(P_phi[j], alpha_inverse);
    }
    return alpha;
}

variance ud_variance(const struct ud_factors *ud, uint8_t k)
{
    variance sum = ud->D[k];
    for (uint8_t j = (uint8_t)(k + 1); j < ud->size; j++) {
        const scalar u = ud->U[column(j) + k];
        sum = add_variance(sum, scale_variance(scale_variance(ud->D[j], u), u));
    }
    return sum;
}
