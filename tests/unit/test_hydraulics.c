/* Cylinder, crank and valve (control/hydraulics) of the reference arm, against its equations in SI. */
#include "control/hydraulics.h"
#include "testing.h"

/* Relative. The image holds binary32 numbers, so no result is better than that. */
#define TOLERANCE BY_TYPE(4e-7, 2e-6, 1.5e-6)
#define SLOPE_TOLERANCE BY_TYPE(1e-7, 3e-5, 4e-6)
#define STEP_RAD BY_TYPE(1e-2, 3e-2, 3e-2)

static struct machine machine;
static struct bases bases;
static struct cylinder_constants constants[JOINTS];
static int area_base, lever_base, pressure_base, volume_base;

/* The reference arm, design/equations.md. */
static const double BORE_M[JOINTS] = {0.032, 0.025};
static const double ROD_M[JOINTS] = {0.018, 0.014};
static const double A_M[JOINTS] = {0.35, 0.28};
static const double B_M[JOINTS] = {0.09, 0.06};
static const double Q0_RAD[JOINTS] = {1.35, 1.60};
static const double DEAD_M3[JOINTS] = {50e-6, 30e-6};
static const double KV[JOINTS] = {6e-8, 4e-8};
static const double SUPPLY_PA = 100e5;
static const double TANK_PA = 3e5;

void setUp(void)
{
    load_reference_arm(&machine, &bases);
    for (uint8_t i = 0; i < JOINTS; i++) {
        constants[i] = cylinder_constants(&machine.cylinder[i]);
    }
    area_base = bases.area;
    lever_base = bases.lever;
    pressure_base = bases.pressure;
    volume_base = base_volume(&bases);
}

void tearDown(void)
{
}

static void expect_relative(double expected, double actual)
{
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE * fabs(expected), expected, actual);
}

/* A parameter as the type can hold it. */
static void expect_parameter(double expected, scalar x, int base_log2)
{
    const double step = BY_TYPE(0, 0, ldexp(STEP, base_log2 - 1));
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE * fabs(expected) + step, expected, si_of(x, base_log2));
}

static double area_m2(uint8_t joint, enum chamber chamber)
{
    const double rod = chamber == ANNULUS ? ROD_M[joint] : 0;
    return PI_REAL / 4 * (BORE_M[joint] * BORE_M[joint] - rod * rod);
}

static double length_m(uint8_t joint, double q)
{
    return sqrt(A_M[joint] * A_M[joint] + B_M[joint] * B_M[joint] -
                2 * A_M[joint] * B_M[joint] * cos(q + Q0_RAD[joint]));
}

static double stroke_m(uint8_t joint)
{
    return length_m(joint, 1.2) - length_m(joint, -1.0) + 0.02;
}

static double volume_m3(uint8_t joint, enum chamber chamber, double q)
{
    const double x = length_m(joint, q) - length_m(joint, -1.0) + 0.01;
    return DEAD_M3[joint] + area_m2(joint, chamber) * (chamber == BORE ? x : stroke_m(joint) - x);
}

static struct cylinder_state state_at(uint8_t joint, double q)
{
    return cylinder_at(&machine.cylinder[joint], &constants[joint], from_real(q));
}

/* lamB or lamC in 1/m */
static double lam_per_m(const struct cylinder_state *state, enum chamber chamber)
{
    return si_of(chamber == BORE ? state->lamB : state->lamC, -lever_base);
}

static void pressures(scalar p[CHAMBERS], double bore_Pa, double annulus_Pa)
{
    p[BORE] = per_unit(bore_Pa, pressure_base);
    p[ANNULUS] = per_unit(annulus_Pa, pressure_base);
}

static void test_reference_arm_is_not_the_one_in_SI(void)
{
    /* GIVEN the built-in image WHEN brought per unit and back THEN the numbers of the reference arm in SI */
    expect_parameter(9.81, machine.arm.g, 0);
    expect_parameter(1.0 / 900, machine.arm.coulomb_rate, 0);
    expect_parameter(3.0, machine.arm.I1, base_torque(&bases));
    expect_parameter(0.8, machine.arm.L1, 0);
    expect_parameter(0.4, machine.arm.L2, 0);
    expect_parameter(SUPPLY_PA, machine.supply.p_supply, pressure_base);
    expect_parameter(TANK_PA, machine.supply.p_tank, pressure_base);
    for (uint8_t i = 0; i < JOINTS; i++) {
        const struct cylinder *const c = &machine.cylinder[i];
        expect_parameter(BORE_M[i], c->bore, area_base / 2);
        expect_parameter(ROD_M[i], c->rod, area_base / 2);
        expect_parameter(DEAD_M3[i], c->dead_volume, volume_base);
        expect_parameter(A_M[i], c->a, lever_base);
        expect_parameter(B_M[i], c->b, lever_base);
        expect_parameter(Q0_RAD[i], c->q0, 0);
        expect_parameter(-1.0, c->q_min, 0);
        expect_parameter(1.2, c->q_max, 0);
        expect_parameter(0.01, c->end_margin, lever_base);
        expect_parameter(KV[i], c->kv, volume_base - pressure_base / 2);
        expect_parameter(2e-13, c->leakage, volume_base - pressure_base);
    }
    const struct estimator_parameters *const e = &machine.estimator;
    expect_parameter(5.0, e->m[M2].value, base_torque(&bases));
    expect_parameter(0.8 / 3, e->m[J].value, base_torque(&bases));
    expect_parameter(12, e->m[FV1].value, base_torque(&bases));
    expect_parameter(4, e->m[FV2].value, base_torque(&bases));
    expect_parameter(6, e->m[FC1].value, base_torque(&bases));
    expect_parameter(2, e->m[FC2].value, base_torque(&bases));
    expect_parameter(1e-9, e->h[BETA_INVERSE].value, -pressure_base);
}

static void test_constants_of_the_cylinders_wrong(void)
{
    /* GIVEN bore, rod and crank WHEN worked out once THEN areas, shortest length and stroke as by hand */
    expect_relative(8.04247719e-4, si_of(constants[SWING].area[BORE], area_base));
    expect_relative(5.49778714e-4, si_of(constants[SWING].area[ANNULUS], area_base));
    expect_relative(4.90873852e-4, si_of(constants[WRIST].area[BORE], area_base));
    expect_relative(3.36935812e-4, si_of(constants[WRIST].area[ANNULUS], area_base));
    expect_relative(0.257244306, si_of(constants[SWING].X_min, lever_base));
    expect_relative(0.180416041, si_of(constants[SWING].x_max, lever_base));
    expect_relative(0.222956484, si_of(constants[WRIST].X_min, lever_base));
    expect_relative(0.124176532, si_of(constants[WRIST].x_max, lever_base));
}

static void test_lever_arm_of_another_triangle(void)
{
    /* GIVEN four angles WHEN the lever arm is taken THEN a b sin / X as by hand */
    static const double q[] = {-0.8, 0, 0.6, 1.1};
    static const double R_m[JOINTS][4] = {{0.0593765302, 0.0899313349, 0.0745861075, 0.0474671824},
                                          {0.049788598, 0.0582954228, 0.0425764773, 0.021418299}};
    for (uint8_t i = 0; i < JOINTS; i++) {
        for (uint8_t k = 0; k < COUNT_OF(q); k++) {
            expect_relative(R_m[i][k], si_of(state_at(i, q[k]).R, lever_base));
        }
        expect_relative(1 / R_m[i][1], si_of(constants[i].lever_inverse, -lever_base)); /* at q = 0 */
    }
}

static void test_lever_arm_is_not_the_slope_of_the_stroke(void)
{
    /* GIVEN the volumes over the range WHEN differentiated by the angle THEN A1 R and -A2 R */
    for (uint8_t i = 0; i < JOINTS; i++) {
        for (double q = -0.9; q < 1.1; q += 0.05) {
            double V[CHAMBERS][4];
            for (uint8_t n = 0; n < 4; n++) {
                static const double at[4] = {-2, -1, 1, 2};
                const struct cylinder_state s = state_at(i, q + at[n] * STEP_RAD);
                V[BORE][n] = real(constants[i].area[BORE]) / real(s.lamB);
                V[ANNULUS][n] = real(constants[i].area[ANNULUS]) / real(s.lamC);
            }
            const double R = real(state_at(i, q).R);
            for (uint8_t c = 0; c < CHAMBERS; c++) {
                const double expected = real(constants[i].area[c]) * (c == BORE ? R : -R);
                const double slope = (8 * (V[c][2] - V[c][1]) - (V[c][3] - V[c][0])) / (12 * STEP_RAD);
                TEST_ASSERT_DOUBLE_WITHIN(SLOPE_TOLERANCE * 10, expected, slope);
            }
        }
    }
}

static void test_chamber_volumes_wrong_at_the_ends(void)
{
    /* GIVEN the ends of the range WHEN volumes are taken THEN dead volume and margin, and the whole stroke */
    for (uint8_t i = 0; i < JOINTS; i++) {
        const struct cylinder_state in = state_at(i, -1.0);
        const struct cylinder_state out = state_at(i, 1.2);
        const double A1 = area_m2(i, BORE);
        const double A2 = area_m2(i, ANNULUS);
        expect_relative(A1 / (DEAD_M3[i] + A1 * 0.01), lam_per_m(&in, BORE));
        expect_relative(A2 / (DEAD_M3[i] + A2 * 0.01), lam_per_m(&out, ANNULUS));
        expect_relative(A2 / (DEAD_M3[i] + A2 * (stroke_m(i) - 0.01)), lam_per_m(&in, ANNULUS));
        expect_relative(A1 / (DEAD_M3[i] + A1 * (stroke_m(i) - 0.01)), lam_per_m(&out, BORE));
    }
}

static void test_volume_below_the_dead_volume_beyond_the_range(void)
{
    /* GIVEN an arm pushed past its range WHEN volumes are taken THEN never less than the dead volume */
    for (uint8_t i = 0; i < JOINTS; i++) {
        for (double q = -1.9; q <= 2.0; q += 0.01) {
            const struct cylinder_state s = state_at(i, q);
            TEST_ASSERT_TRUE(lam_per_m(&s, BORE) <= area_m2(i, BORE) / DEAD_M3[i] * (1 + TOLERANCE));
            TEST_ASSERT_TRUE(lam_per_m(&s, ANNULUS) <= area_m2(i, ANNULUS) / DEAD_M3[i] * (1 + TOLERANCE));
            TEST_ASSERT_TRUE(s.lamB > SCALAR(0) && s.lamC > SCALAR(0));
        }
    }
    /* the wrist's crank reaches further in than its stroke, the swing's further out */
    const struct cylinder_state in = state_at(WRIST, -Q0_RAD[WRIST] + 0.02);
    expect_relative(area_m2(WRIST, BORE) / DEAD_M3[WRIST], lam_per_m(&in, BORE));
    const struct cylinder_state out = state_at(SWING, PI_REAL - Q0_RAD[SWING] - 0.02);
    expect_relative(area_m2(SWING, ANNULUS) / DEAD_M3[SWING], lam_per_m(&out, ANNULUS));
}

static void test_lamA_not_made_of_areas_and_volumes(void)
{
    /* GIVEN the range WHEN lamA is taken THEN A1^2/V1 + A2^2/V2 */
    for (uint8_t i = 0; i < JOINTS; i++) {
        for (double q = -1; q <= 1.2; q += 0.05) {
            const struct cylinder_state s = state_at(i, q);
            double expected = 0;
            for (uint8_t c = 0; c < CHAMBERS; c++) {
                const double A = area_m2(i, (enum chamber)c);
                expected += A * A / volume_m3(i, (enum chamber)c, q);
            }
            TEST_ASSERT_DOUBLE_WITHIN(2 * TOLERANCE * expected, expected,
                                      si_of(s.lamA, area_base - lever_base));
        }
    }
}

static void test_force_of_the_wrong_side(void)
{
    /* GIVEN 60 and 20 bar WHEN the force is taken THEN p1 A1 - p2 A2, positive extending */
    scalar p[CHAMBERS];
    pressures(p, 60e5, 20e5);
    expect_relative(60e5 * 8.04247719e-4 - 20e5 * 5.49778714e-4,
                    si_of(cylinder_force(&constants[SWING], p), pressure_base + area_base));
    expect_relative(60e5 * 4.90873852e-4 - 20e5 * 3.36935812e-4,
                    si_of(cylinder_force(&constants[WRIST], p), pressure_base + area_base));
    pressures(p, 10e5, 80e5);
    TEST_ASSERT_TRUE(cylinder_force(&constants[SWING], p) < SCALAR(0));
}

static void test_valve_gain_takes_the_root_of_another_port(void)
{
    /* GIVEN four different pressure drops WHEN the spool opens either way THEN each port has its own root:
     * supply to bore and annulus to tank, or bore to tank and supply to annulus */
    scalar p[CHAMBERS];
    pressures(p, 60e5, 20e5);
    const int gain_base = area_base; /* QL: m^2/s */
    for (uint8_t i = 0; i < JOINTS; i++) {
        const struct cylinder_state s = state_at(i, 0.3);
        const double lamB = area_m2(i, BORE) / volume_m3(i, BORE, 0.3);
        const double lamC = area_m2(i, ANNULUS) / volume_m3(i, ANNULUS, 0.3);
        const double out = KV[i] * (lamB * sqrt(SUPPLY_PA - 60e5) + lamC * sqrt(20e5 - TANK_PA));
        const double in = KV[i] * (lamB * sqrt(60e5 - TANK_PA) + lamC * sqrt(SUPPLY_PA - 20e5));
        expect_relative(out,
                        si_of(valve_gain(&machine.cylinder[i], &machine.supply, &s, p, true), gain_base));
        expect_relative(in,
                        si_of(valve_gain(&machine.cylinder[i], &machine.supply, &s, p, false), gain_base));
    }
}

static void test_valve_gain_vanishes_when_a_pressure_drop_does(void)
{
    /* GIVEN chambers above supply and below tank WHEN the gain is taken THEN that of the smallest drop: u =
     * QL / gain never divides by zero */
    scalar p[CHAMBERS];
    const double dp_min = default_value("supply.dp_min_Pa");
    const struct cylinder_state s = state_at(WRIST, 0.3);
    const double lam = lam_per_m(&s, BORE) + lam_per_m(&s, ANNULUS);
    pressures(p, 110e5, 1e5);
    expect_relative(KV[WRIST] * lam * sqrt(dp_min),
                    si_of(valve_gain(&machine.cylinder[WRIST], &machine.supply, &s, p, true), area_base));
    pressures(p, 0, 150e5);
    expect_relative(KV[WRIST] * lam * sqrt(dp_min),
                    si_of(valve_gain(&machine.cylinder[WRIST], &machine.supply, &s, p, false), area_base));
}

static void test_overlap_passes_oil(void)
{
    /* GIVEN a valve of 2 % overlap WHEN its spool is within THEN nothing passes, beyond it what is left */
    struct cylinder cylinder = machine.cylinder[WRIST];
    cylinder.overlap = SCALAR(0.02);
    TEST_ASSERT_TRUE(valve_opening(&cylinder, SCALAR(0.02)) == SCALAR(0));
    TEST_ASSERT_TRUE(valve_opening(&cylinder, SCALAR(-0.015)) == SCALAR(0));
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0.08, real(valve_opening(&cylinder, SCALAR(0.1))));
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, -0.08, real(valve_opening(&cylinder, SCALAR(-0.1))));
}

static void test_overlap_not_made_up_for(void)
{
    /* GIVEN overlap or none WHEN the spool for a wanted opening is taken THEN it passes that much, but for
     * the smallest openings, where the spool must neither jump nor turn back */
    static const double overlaps[] = {0, 0.02, 0.2};
    for (unsigned n = 0; n < COUNT_OF(overlaps); n++) {
        struct cylinder cylinder = machine.cylinder[WRIST];
        cylinder.overlap = from_real(overlaps[n]);
        double before = real(valve_spool(&cylinder, SCALAR(-0.8)));
        for (double opening = -0.8; opening <= 0.8; opening += 1e-4) {
            const scalar spool = valve_spool(&cylinder, from_real(opening));
            if (fabs(opening) > 0.006) {
                TEST_ASSERT_DOUBLE_WITHIN(1e-6, opening, real(valve_opening(&cylinder, spool)));
            }
            TEST_ASSERT_TRUE(real(spool) >= before - 1e-6);
            TEST_ASSERT_TRUE(real(spool) <= before + 1e-4 * (1 + overlaps[n] / 0.004) + 1e-6);
            before = real(spool);
        }
        TEST_ASSERT_TRUE(valve_spool(&cylinder, SCALAR(0)) == SCALAR(0));
    }
}

static void test_leakage_pumps(void)
{
    /* GIVEN more pressure on the bore side WHEN oil leaks THEN it takes force, the other way it gives */
    scalar p[CHAMBERS];
    const struct cylinder_state s = state_at(SWING, 0.3);
    const double lam = lam_per_m(&s, BORE) + lam_per_m(&s, ANNULUS);
    pressures(p, 60e5, 20e5);
    expect_relative(lam * 2e-13 * 40e5, si_of(cylinder_leakage(&machine.cylinder[SWING], &s, p), area_base));
    pressures(p, 20e5, 60e5);
    expect_relative(-lam * 2e-13 * 40e5, si_of(cylinder_leakage(&machine.cylinder[SWING], &s, p), area_base));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_reference_arm_is_not_the_one_in_SI);
    RUN_TEST(test_constants_of_the_cylinders_wrong);
    RUN_TEST(test_lever_arm_of_another_triangle);
    RUN_TEST(test_lever_arm_is_not_the_slope_of_the_stroke);
    RUN_TEST(test_chamber_volumes_wrong_at_the_ends);
    RUN_TEST(test_volume_below_the_dead_volume_beyond_the_range);
    RUN_TEST(test_lamA_not_made_of_areas_and_volumes);
    RUN_TEST(test_force_of_the_wrong_side);
    RUN_TEST(test_valve_gain_takes_the_root_of_another_port);
    RUN_TEST(test_valve_gain_vanishes_when_a_pressure_drop_does);
    RUN_TEST(test_overlap_passes_oil);
    RUN_TEST(test_overlap_not_made_up_for);
    RUN_TEST(test_leakage_pumps);
    return UNITY_END();
}
