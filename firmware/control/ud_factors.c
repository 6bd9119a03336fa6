#include "control/ud_factors.h"

/* Where column j of U begins. */
static inline uint8_t column(uint8_t j)
{
    return j > 0u ? (uint8_t)(j * (j - 1u) / 2u) : (uint8_t)0;
}

SELDOM void ud_start(struct ud_factors *ud, uint8_t size, const variance prior[])
{
    *ud = (struct ud_factors){.size = size};
    for (uint8_t k = 0; k < size; k++) {
        ud->D[k] = prior[k];
    }
}

/* Column j of the update: f = U' phi and v = D f of it, then what it tells of the columns before. Returns alpha. */
static inline variance update_column(variance *D, scalar Uj[], uint8_t j, const scalar phi[], variance alpha,
                                     inverse *alpha_inverse, variance P_phi[])
{
    wide sum = wide_of(phi[j]);
    UNROLL_SHORT_LOOP
    for (uint8_t i = 0; i < j; i++) {
        sum = add_product(sum, Uj[i], phi[i]);
    }
    const scalar f = narrow(sum);
    const variance v = scale_variance(*D, f);
    P_phi[j] = v;
    const inverse f_over_alpha = scale_inverse(*alpha_inverse, f);
    UNROLL_SHORT_LOOP
    for (uint8_t i = 0; i < j; i++) {
        const scalar u = Uj[i];
        const variance p = P_phi[i];
        P_phi[i] = add_scaled_variance(p, v, u);
        Uj[i] = add_limited(u, -variance_share(p, f_over_alpha));
    }
    const variance alpha_after = add_scaled_variance(alpha, v, f);
    *alpha_inverse = invert(alpha_after);
    *D = scale_variance(*D, variance_part(alpha, *alpha_inverse));
    return alpha_after;
}

variance ud_update(struct ud_factors *ud, const scalar phi[], variance noise, gain K[])
{
    variance P_phi[UD_SIZE_MAX];
    variance alpha = noise; /* variance of the noise, then of the innovation as columns are added */
    inverse alpha_inverse = invert(alpha);
    /* to the largest size, and out before: where loops are unrolled nothing of them is left but that */
    UNROLL_SHORT_LOOP
    for (uint8_t j = 0; j < UD_SIZE_MAX; j++) {
        if (j == ud->size) {
            break;
        }
        alpha = update_column(&ud->D[j], &ud->U[column(j)], j, phi, alpha, &alpha_inverse, P_phi);
    }
    for (uint8_t j = 0; j < ud->size; j++) {
        K[j] = variance_ratio(P_phi[j], alpha_inverse);
    }
    return alpha;
}

variance ud_variance(const struct ud_factors *ud, uint8_t k)
{
    variance sum = ud->D[k];
    uint8_t at = (uint8_t)(column((uint8_t)(k + 1u)) + k);
    for (uint8_t j = (uint8_t)(k + 1u); j < ud->size; j++) {
        const scalar u = ud->U[at];
        sum = add_scaled_variance(sum, scale_variance(ud->D[j], u), u);
        at = (uint8_t)(at + j);
    }
    return sum;
}
