#include "control/hydraulics.h"

#define QUARTER_PI SCALAR(0.78539816339744830962)

static scalar cylinder_length(const struct cylinder_constants *constants, scalar cosine_of_triangle)
{
    return root(constants->a2_plus_b2 - mul(SCALAR(2), mul(constants->ab, cosine_of_triangle)));
}

SELDOM struct cylinder_constants cylinder_constants(const struct cylinder *cylinder)
{
    struct cylinder_constants constants = {0};
    const scalar bore_squared = mul(cylinder->bore, cylinder->bore);
    constants.area[BORE] = mul(QUARTER_PI, bore_squared);
    constants.area[ANNULUS] = mul(QUARTER_PI, bore_squared - mul(cylinder->rod, cylinder->rod));
    constants.a2_plus_b2 = mul(cylinder->a, cylinder->a) + mul(cylinder->b, cylinder->b);
    constants.ab = mul(cylinder->a, cylinder->b);
    const scalar shortest = cylinder_length(&constants, cosine(cylinder->q_min + cylinder->q0));
    const scalar longest = cylinder_length(&constants, cosine(cylinder->q_max + cylinder->q0));
    constants.X_min = shortest - cylinder->end_margin;
    constants.lever_inverse =
        quot(cylinder_length(&constants, cosine(cylinder->q0)), mul(constants.ab, sine(cylinder->q0)));
    constants.x_max = longest - shortest + mul(SCALAR(2), cylinder->end_margin);
    return constants;
}

struct cylinder_state cylinder_at(const struct cylinder *cylinder, const struct cylinder_constants *constants,
                                  scalar q)
{
    const struct sine_cosine triangle = sine_cosine(q + cylinder->q0);
    const scalar X = cylinder_length(constants, triangle.c);
    const scalar x = limit(X - constants->X_min, SCALAR(0), constants->x_max);
    const scalar V1 = cylinder->dead_volume + mul(constants->area[BORE], x);
    const scalar V2 = cylinder->dead_volume + mul(constants->area[ANNULUS], constants->x_max - x);
    struct cylinder_state state;
    state.R = quot(mul(constants->ab, triangle.s), X);
    state.lamB = quot(constants->area[BORE], V1);
    state.lamC = quot(constants->area[ANNULUS], V2);
    state.lamA = narrow(add_product(add_product(wide_of(SCALAR(0)), constants->area[BORE], state.lamB),
                                    constants->area[ANNULUS], state.lamC));
    return state;
}

scalar cylinder_force(const struct cylinder_constants *constants, const scalar p[CHAMBERS])
{
    const wide force = add_product(wide_of(SCALAR(0)), p[BORE], constants->area[BORE]);
    return narrow(subtract_product(force, p[ANNULUS], constants->area[ANNULUS]));
}

scalar valve_gain(const struct cylinder *cylinder, const struct supply *supply,
                  const struct cylinder_state *state, const scalar p[CHAMBERS], bool extending)
{
    const scalar drop1 = extending ? supply->p_supply - p[BORE] : p[BORE] - supply->p_tank;
    const scalar drop2 = extending ? p[ANNULUS] - supply->p_tank : supply->p_supply - p[ANNULUS];
    const scalar per_root = mul(state->lamB, root(larger(drop1, supply->dp_min))) +
                            mul(state->lamC, root(larger(drop2, supply->dp_min)));
    return mul(cylinder->kv, per_root);
}

/* Opening over which the inverse of the overlap is smoothed. */
#define PER_OVERLAP_BLEND GAIN(1 / 0.005)

scalar valve_opening(const struct cylinder *cylinder, scalar spool)
{
    return spool - limit(spool, -cylinder->overlap, cylinder->overlap);
}

scalar valve_spool(const struct cylinder *cylinder, scalar opening)
{
    const scalar side = limit(amp(PER_OVERLAP_BLEND, opening), SCALAR(-1), SCALAR(1));
    return opening + mul(cylinder->overlap, side);
}

scalar cylinder_leakage(const struct cylinder *cylinder, const struct cylinder_state *state,
                        const scalar p[CHAMBERS])
{
    return mul(state->lamB + state->lamC, mul(cylinder->leakage, p[BORE] - p[ANNULUS]));
}
