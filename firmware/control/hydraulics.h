/* A double-acting cylinder on a crank, and the spool valve that feeds it. A side 1 = bore, side 2 = annulus;
 * extension is positive rotation.
 *
 *     F'/be = -lamA R q' + u gain - (lamB + lamC) c_l (p1 - p2) + lamB Om2 + lamC Om3            (Eq 6)
 *     lamB = A1/V1, lamC = A2/V2, lamA = A1 lamB + A2 lamC
 *
 * Om2 and Om3 are the flow offsets into chamber 1 and out of chamber 2. */
#ifndef CONTROL_HYDRAULICS_H
#define CONTROL_HYDRAULICS_H

#include "control/scalar.h"

enum chamber { BORE, ANNULUS, CHAMBERS };

/* Primary parameters, as on the data sheets. */
struct cylinder {
    scalar bore;         /* m, on the root of the area's base */
    scalar rod;          /* m, on the same */
    scalar dead_volume;  /* m^3, each chamber */
    scalar a, b;         /* triangle: X^2 = a^2 + b^2 - 2ab cos(q + q0); m, on the lever base */
    scalar q0;           /* rad */
    scalar q_min, q_max; /* joint range, rad */
    scalar end_margin;   /* stroke to spare at each end, m on the lever base */
    scalar kv;           /* Q = kv u sqrt(dp), m^3/s/sqrt(Pa), u in -1..1 */
    scalar overlap;      /* spool travel either side of the middle that passes nothing */
    scalar leakage;      /* c_l, m^3/s/Pa */
};

struct supply {
    scalar p_supply, p_tank; /* Pa */
    scalar dp_min;           /* smallest pressure drop the valve gain is computed with, Pa */
};

/* What follows from the primary parameters once. */
struct cylinder_constants {
    scalar area[CHAMBERS]; /* A1, A2 */
    scalar a2_plus_b2;
    scalar ab;
    scalar X_min;         /* length when retracted */
    scalar x_max;         /* stroke */
    scalar lever_inverse; /* 1 / R at q = 0 */
};

/* The cylinder at one joint angle. */
struct cylinder_state {
    scalar R;                /* dX/dq, m/rad */
    scalar lamB, lamC, lamA; /* A1/V1, A2/V2, A1 lamB + A2 lamC */
};

struct cylinder_constants cylinder_constants(const struct cylinder *cylinder);

/* At joint angle q, rad; volumes never fall below the dead volume. */
struct cylinder_state cylinder_at(const struct cylinder *cylinder, const struct cylinder_constants *constants,
                                  scalar q);

/* F = p1 A1 - p2 A2. */
scalar cylinder_force(const struct cylinder_constants *constants, const scalar p[CHAMBERS]);

/* QL per unit spool, Eq 7 with one root per port and per sign of u: the factor of u in Eq 6. Always > 0. */
scalar valve_gain(const struct cylinder *cylinder, const struct supply *supply,
                  const struct cylinder_state *state, const scalar p[CHAMBERS], bool extending);

/* What of the spool's position passes oil, and its inverse, Eq 7: the position for a wanted opening. The inverse
 * is smoothed over an opening of 0.5 %, where the spool would otherwise jump with every change of sign. */
scalar valve_opening(const struct cylinder *cylinder, scalar spool);
scalar valve_spool(const struct cylinder *cylinder, scalar opening);

/* (lamB + lamC) c_l (p1 - p2): what leakage takes from QL. */
scalar cylinder_leakage(const struct cylinder *cylinder, const struct cylinder_state *state,
                        const scalar p[CHAMBERS]);

#endif
