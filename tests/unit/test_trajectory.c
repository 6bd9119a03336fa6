/* Point-to-point moves and their brake (control/trajectory): 0.6 rad in 1.5 s at 1 kHz, as in the paper's benchmark. */
#include "control/trajectory.h"
#include "testing.h"

/* Of angles of order one; rates and accelerations are checked numerically over SPAN ticks. */
#define TOLERANCE BY_TYPE(1e-13, 1e-5, 1e-5)
#define SLOPE_TOLERANCE BY_TYPE(2e-6, 3e-4, 2e-4)
#define BRAKE_SLOPE BY_TYPE(2e-4, 4e-4, 4e-4)
#define LONG_MOVE BY_TYPE(1e-4, 1e-4, 1e-3) /* relative, of the greatest rate */

/* So many ticks before the end the rate is still more than the type's step. */
#define LAST_MOVING BY_TYPE(1, 1, 5)

enum { TICKS = 1500, SPAN = 10, BRAKE_SPAN = 2 };

static const double DT_S = 1e-3;
static const double START_RAD = -0.2;
static const double TARGET_RAD = 0.4;
static const double DISTANCE_RAD = 0.6;
static const double DURATION_S = 1.5;

static struct trajectory trajectory;
static struct reference samples[TICKS + 1];

void setUp(void)
{
    trajectory = trajectory_at_rest(from_real(START_RAD));
}

void tearDown(void)
{
}

static bool begin(void)
{
    return trajectory_start(&trajectory, from_real(TARGET_RAD), TICKS, from_real(DT_S));
}

/* The whole move, both ends included. */
static void record(void)
{
    TEST_ASSERT_TRUE(begin());
    for (int k = 0; k <= TICKS; k++) {
        samples[k] = trajectory_now(&trajectory);
        trajectory_advance(&trajectory, from_real(DT_S));
    }
}

static void test_move_does_not_begin_at_rest(void)
{
    /* GIVEN rest WHEN a move starts THEN its first sample is the start, exactly and without rate */
    TEST_ASSERT_TRUE(begin());
    const struct reference first = trajectory_now(&trajectory);
    TEST_ASSERT_TRUE(first.q == from_real(START_RAD));
    TEST_ASSERT_TRUE(first.w == SCALAR(0));
    TEST_ASSERT_TRUE(first.a == SCALAR(0));
}

static void test_move_does_not_end_at_rest_at_its_target(void)
{
    /* GIVEN a move WHEN its last tick has passed THEN it rests at the target, after that many ticks, not one
     * less */
    record();
    TEST_ASSERT_DOUBLE_WITHIN(STEP, TARGET_RAD, real(samples[TICKS].q));
    TEST_ASSERT_TRUE(samples[TICKS].w == SCALAR(0));
    TEST_ASSERT_TRUE(samples[TICKS].a == SCALAR(0));
    TEST_ASSERT_TRUE(samples[TICKS - LAST_MOVING].w > SCALAR(0));
    TEST_ASSERT_FALSE(trajectory_moving(&trajectory));
    setUp();
    TEST_ASSERT_TRUE(begin());
    for (int k = 0; k < TICKS; k++) {
        TEST_ASSERT_TRUE(trajectory_moving(&trajectory));
        trajectory_advance(&trajectory, from_real(DT_S));
    }
    TEST_ASSERT_FALSE(trajectory_moving(&trajectory));
}

static void test_end_point_creeps_away_over_many_moves(void)
{
    /* GIVEN a thousand moves to and fro WHEN each has ended THEN its end is the target, whatever came before
     * */
    struct lcg noise = {3};
    for (int n = 0; n < 1000; n++) {
        const scalar target = from_real(lcg_uniform(&noise, -1, 1.2));
        TEST_ASSERT_TRUE(trajectory_start(&trajectory, target, 7, from_real(DT_S)));
        for (int k = 0; k < 7; k++) {
            trajectory_advance(&trajectory, from_real(DT_S));
        }
        TEST_ASSERT_FALSE(trajectory_moving(&trajectory));
        TEST_ASSERT_DOUBLE_WITHIN(2 * STEP, real(target), real(trajectory_now(&trajectory).q));
    }
}

static void test_acceleration_or_jerk_jumps(void)
{
    /* GIVEN a whole move, ends included WHEN the acceleration is followed THEN it never steps by more than
     * the profile's greatest jerk allows, |s'''| <= 52.5, and hardly at all near the ends, where jerk is zero
     * */
    record();
    const double step = 52.5 * DISTANCE_RAD / (DURATION_S * DURATION_S * DURATION_S) * DT_S;
    double greatest = 0;
    for (int k = 0; k < TICKS; k++) {
        greatest = fmax(greatest, fabs(real(samples[k + 1].a) - real(samples[k].a)));
    }
    TEST_ASSERT_TRUE(greatest < step * 1.001 + TOLERANCE);
    TEST_ASSERT_TRUE(greatest > step * 0.99 - TOLERANCE);
    TEST_ASSERT_DOUBLE_WITHIN(step / 50, 0, real(samples[1].a));
    TEST_ASSERT_DOUBLE_WITHIN(step / 50, 0, real(samples[TICKS - 1].a));
}

static void test_rate_is_not_the_slope_of_the_angle(void)
{
    /* GIVEN a whole move WHEN angle and rate are differentiated THEN rate and acceleration, in SI */
    record();
    const double h = SPAN * DT_S;
    for (int k = 2 * SPAN; k <= TICKS - 2 * SPAN; k++) {
        const struct reference *const s = &samples[k];
        const double slope_q =
            (8 * (real(s[SPAN].q) - real(s[-SPAN].q)) - (real(s[2 * SPAN].q) - real(s[-2 * SPAN].q))) /
            (12 * h);
        const double slope_w =
            (8 * (real(s[SPAN].w) - real(s[-SPAN].w)) - (real(s[2 * SPAN].w) - real(s[-2 * SPAN].w))) /
            (12 * h);
        TEST_ASSERT_DOUBLE_WITHIN(SLOPE_TOLERANCE, real(s->w), slope_q);
        TEST_ASSERT_DOUBLE_WITHIN(3 * SLOPE_TOLERANCE, real(s->a), slope_w);
    }
}

static void test_profile_is_another(void)
{
    /* GIVEN a whole move WHEN it is half over THEN half the way at the greatest rate, 140/64 of the mean, and
     * it never leaves the way between its ends */
    record();
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, (START_RAD + TARGET_RAD) / 2, real(samples[TICKS / 2].q));
    TEST_ASSERT_DOUBLE_WITHIN(10 * TOLERANCE, 140.0 / 64 * DISTANCE_RAD / DURATION_S,
                              real(samples[TICKS / 2].w));
    TEST_ASSERT_DOUBLE_WITHIN(100 * TOLERANCE, 0, real(samples[TICKS / 2].a));
    for (int k = 0; k < TICKS; k++) {
        TEST_ASSERT_TRUE(real(samples[k].q) >= START_RAD - TOLERANCE);
        TEST_ASSERT_TRUE(real(samples[k].q) <= TARGET_RAD + TOLERANCE);
    }
}

static void test_new_target_takes_over_half_way(void)
{
    /* GIVEN a move under way WHEN another is asked for THEN refused, and the first goes on undisturbed */
    TEST_ASSERT_TRUE(begin());
    for (int k = 0; k < 700; k++) {
        trajectory_advance(&trajectory, from_real(DT_S));
    }
    const struct trajectory before = trajectory;
    TEST_ASSERT_FALSE(trajectory_start(&trajectory, SCALAR(-0.9), 100, from_real(DT_S)));
    TEST_ASSERT_EQUAL_MEMORY(&before, &trajectory, sizeof before);
    TEST_ASSERT_TRUE(trajectory_moving(&trajectory));
}

static void test_move_in_no_time_jumps(void)
{
    /* GIVEN rest WHEN a move of 0 ticks, or of more than can be counted, is asked for THEN refused, still at
     * rest */
    TEST_ASSERT_FALSE(trajectory_start(&trajectory, from_real(TARGET_RAD), 0, from_real(DT_S)));
    TEST_ASSERT_FALSE(trajectory_start(&trajectory, from_real(TARGET_RAD), UINT32_MAX, from_real(DT_S)));
    TEST_ASSERT_FALSE(trajectory_moving(&trajectory));
    TEST_ASSERT_TRUE(trajectory_now(&trajectory).q == from_real(START_RAD));
}

static void test_rest_drifts(void)
{
    /* GIVEN a finished move WHEN time goes on THEN nothing moves any more, and the next move may start */
    record();
    const struct reference end = trajectory_now(&trajectory);
    for (int k = 0; k < 1000; k++) {
        trajectory_advance(&trajectory, from_real(DT_S));
        const struct reference now = trajectory_now(&trajectory);
        TEST_ASSERT_TRUE(now.q == end.q && now.w == SCALAR(0) && now.a == SCALAR(0));
    }
    TEST_ASSERT_TRUE(trajectory_start(&trajectory, from_real(START_RAD), 1, from_real(DT_S)));
    trajectory_advance(&trajectory, from_real(DT_S));
    TEST_ASSERT_DOUBLE_WITHIN(STEP, START_RAD, real(trajectory_now(&trajectory).q));
}

static void test_rate_of_a_long_move_is_not_the_mean_times_its_profile(void)
{
    /* GIVEN the shortest and the longest moves that a request may ask for, at the shortest and at the longest
     * period WHEN half over THEN rate and duration belong together */
    static const struct {
        double dt_s, duration_s;
    } moves[] = {{250e-6, 65.535}, {250e-6, 50.0}, {1e-3, 65.535},
                 {1e-3, 60.0},     {20e-3, 65.52}, {250e-6, 0.5}};
    for (unsigned n = 0; n < COUNT_OF(moves); n++) {
        setUp();
        const uint32_t ticks = (uint32_t)lround(moves[n].duration_s / moves[n].dt_s);
        TEST_ASSERT_TRUE(
            trajectory_start(&trajectory, from_real(TARGET_RAD), ticks, from_real(moves[n].dt_s)));
        trajectory.tick = ticks / 2;
        const double expected = 140.0 / 64 * DISTANCE_RAD / moves[n].duration_s;
        TEST_ASSERT_DOUBLE_WITHIN(LONG_MOVE * expected, expected, real(trajectory_now(&trajectory).w));
    }
}

/* Brake the move after `begun` of its ticks, within `length` ticks; path[k] is k ticks after the brake began. */
enum { BRAKE_MOST = 400 };
static struct reference path[BRAKE_MOST + 2];

static void record_brake(int begun, uint16_t length)
{
    setUp();
    TEST_ASSERT_TRUE(begin());
    for (int k = 0; k < begun; k++) {
        trajectory_advance(&trajectory, from_real(DT_S));
    }
    trajectory_brake(&trajectory, length, from_real(DT_S));
    for (unsigned k = 0; k <= length + 1u; k++) {
        path[k] = trajectory_now(&trajectory);
        trajectory_advance(&trajectory, from_real(DT_S));
    }
}

static const int BEGUN[] = {1, 40, 375, 750, 1125, 1400, 1499};
static const uint16_t LENGTHS[] = {1, 2, 50, 200, BRAKE_MOST};

static void test_brake_does_not_end_at_rest_in_time(void)
{
    /* GIVEN a move, anywhere on its way WHEN braked THEN at rest after the brake's ticks, and there it stays */
    for (unsigned b = 0; b < COUNT_OF(BEGUN); b++) {
        for (unsigned n = 0; n < COUNT_OF(LENGTHS); n++) {
            record_brake(BEGUN[b], LENGTHS[n]);
            TEST_ASSERT_FALSE(trajectory_moving(&trajectory));
            const struct reference *const end = &path[LENGTHS[n]];
            TEST_ASSERT_TRUE(end->w == SCALAR(0) && end->a == SCALAR(0));
            TEST_ASSERT_TRUE(path[LENGTHS[n] + 1].q == end->q);
            TEST_ASSERT_TRUE(trajectory_now(&trajectory).q == end->q);
        }
    }
}

static void test_brake_leaves_the_path_or_turns_back(void)
{
    /* GIVEN a move, anywhere on its way WHEN braked THEN the angle goes on towards the target, never past it; at the
     * move's greatest rate by half of what that rate makes in the brake's time: the mean of a smooth step */
    for (unsigned b = 0; b < COUNT_OF(BEGUN); b++) {
        for (unsigned n = 0; n < COUNT_OF(LENGTHS); n++) {
            record_brake(BEGUN[b], LENGTHS[n]);
            for (unsigned k = 1; k <= LENGTHS[n]; k++) {
                TEST_ASSERT_TRUE(real(path[k].q) >= real(path[k - 1].q) - TOLERANCE);
                TEST_ASSERT_TRUE(real(path[k].q) <= TARGET_RAD + TOLERANCE);
            }
        }
    }
    record_brake(750, 50); /* there the rate's own change is of second order */
    const double expected = 0.5 * real(path[0].w) * 50 * DT_S;
    TEST_ASSERT_DOUBLE_WITHIN(0.01 * expected, expected, real(path[50].q) - real(path[0].q));
}

static void test_brake_begins_or_ends_with_a_jump(void)
{
    /* GIVEN a move, anywhere on its way WHEN braked THEN its first instant is the move's own in angle, rate and
     * acceleration, and from tick to tick rate and acceleration step by no more than the slopes of the move and of a
     * smooth step sigma allow: |sigma'| <= 1.5 / T, |sigma''| <= 6 / T^2 */
    static const uint16_t lengths[] = {50, 200, BRAKE_MOST};
    record();
    for (unsigned b = 0; b < COUNT_OF(BEGUN); b++) {
        for (unsigned n = 0; n < COUNT_OF(lengths); n++) {
            record_brake(BEGUN[b], lengths[n]);
            const struct reference *const move = &samples[BEGUN[b]];
            TEST_ASSERT_TRUE(path[0].q == move->q);
            TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, real(move->w), real(path[0].w));
            TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, real(move->a), real(path[0].a));
            const double T_s = lengths[n] * DT_S;
            const double w_most = 140.0 / 64 * DISTANCE_RAD / DURATION_S;
            const double a_most = 7.52 * DISTANCE_RAD / (DURATION_S * DURATION_S);
            const double j_most = 52.5 * DISTANCE_RAD / (DURATION_S * DURATION_S * DURATION_S);
            const double w_step = (a_most + 1.5 / T_s * w_most) * DT_S;
            const double a_step = (j_most + 3 * 1.5 / T_s * a_most + 6 / (T_s * T_s) * w_most) * DT_S;
            for (unsigned k = 0; k <= lengths[n]; k++) {
                TEST_ASSERT_DOUBLE_WITHIN(w_step + TOLERANCE, real(path[k].w), real(path[k + 1].w));
                TEST_ASSERT_DOUBLE_WITHIN(a_step + 100 * TOLERANCE, real(path[k].a), real(path[k + 1].a));
            }
        }
    }
}

static void test_braking_rate_is_not_the_slope_of_the_angle(void)
{
    /* GIVEN brakes before, at and after the middle of a move WHEN angle and rate are differentiated THEN rate and
     * acceleration, in SI */
    static const int begun[] = {300, 750, 1100};
    for (unsigned b = 0; b < COUNT_OF(begun); b++) {
        record_brake(begun[b], 200);
        for (unsigned k = BRAKE_SPAN; k <= 200u - BRAKE_SPAN; k++) {
            const double h = BRAKE_SPAN * DT_S;
            const double slope_q = (real(path[k + BRAKE_SPAN].q) - real(path[k - BRAKE_SPAN].q)) / (2 * h);
            const double slope_w = (real(path[k + BRAKE_SPAN].w) - real(path[k - BRAKE_SPAN].w)) / (2 * h);
            TEST_ASSERT_DOUBLE_WITHIN(BRAKE_SLOPE, real(path[k].w), slope_q);
            TEST_ASSERT_DOUBLE_WITHIN(20 * BRAKE_SLOPE, real(path[k].a), slope_w);
        }
    }
}

static void test_brake_of_an_ending_move_overshoots_its_target(void)
{
    /* GIVEN a move of a few ticks WHEN braked so late and so slowly that its end comes first THEN it ends there */
    TEST_ASSERT_TRUE(trajectory_start(&trajectory, from_real(TARGET_RAD), 5, from_real(DT_S)));
    for (int k = 0; k < 4; k++) {
        trajectory_advance(&trajectory, from_real(DT_S));
    }
    trajectory_brake(&trajectory, 1000, from_real(DT_S));
    for (int k = 0; k < 3; k++) {
        trajectory_advance(&trajectory, from_real(DT_S));
    }
    TEST_ASSERT_FALSE(trajectory_moving(&trajectory));
    TEST_ASSERT_DOUBLE_WITHIN(STEP, TARGET_RAD, real(trajectory_now(&trajectory).q));
}

static void test_brake_at_rest_or_twice_changes_something(void)
{
    /* GIVEN rest, a brake under way, or a brake of no ticks WHEN braked THEN nothing changes; a move may start once the
     * brake is over, not before */
    struct trajectory before = trajectory;
    trajectory_brake(&trajectory, 100, from_real(DT_S));
    TEST_ASSERT_EQUAL_MEMORY(&before, &trajectory, sizeof before);
    TEST_ASSERT_TRUE(begin());
    for (int k = 0; k < 700; k++) {
        trajectory_advance(&trajectory, from_real(DT_S));
    }
    before = trajectory;
    trajectory_brake(&trajectory, 0, from_real(DT_S));
    TEST_ASSERT_EQUAL_MEMORY(&before, &trajectory, sizeof before);
    trajectory_brake(&trajectory, 100, from_real(DT_S));
    trajectory_advance(&trajectory, from_real(DT_S));
    before = trajectory;
    trajectory_brake(&trajectory, 50, from_real(DT_S));
    TEST_ASSERT_EQUAL_MEMORY(&before, &trajectory, sizeof before);
    for (int k = 1; k < 100; k++) {
        TEST_ASSERT_FALSE(begin());
        trajectory_advance(&trajectory, from_real(DT_S));
    }
    TEST_ASSERT_TRUE(begin());
    TEST_ASSERT_EQUAL_UINT16(0, trajectory.brake_ticks); /* and it does not brake by itself */
}

static void test_smooth_step_is_not_smooth(void)
{
    /* GIVEN 0 .. 1 WHEN stepped through THEN from 1 to 0, one half in the middle, falling, flat at both ends */
    TEST_ASSERT_TRUE(smooth_step_down(SCALAR(0)) == SCALAR(1));
    TEST_ASSERT_TRUE(smooth_step_down(SCALAR(1)) == SCALAR(0));
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, 0.5, real(smooth_step_down(SCALAR(0.5))));
    double before = 1;
    for (int k = 1; k <= 1000; k++) {
        const double now = real(smooth_step_down(from_real(k / 1000.0)));
        TEST_ASSERT_TRUE(now <= before + TOLERANCE);
        TEST_ASSERT_TRUE(before - now <= 1.5e-3 + TOLERANCE);
        before = now;
    }
    TEST_ASSERT_DOUBLE_WITHIN(4e-6 + TOLERANCE, 1, real(smooth_step_down(SCALAR(0.001))));
    TEST_ASSERT_DOUBLE_WITHIN(4e-6 + TOLERANCE, 0, real(smooth_step_down(SCALAR(0.999))));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_move_does_not_begin_at_rest);
    RUN_TEST(test_move_does_not_end_at_rest_at_its_target);
    RUN_TEST(test_end_point_creeps_away_over_many_moves);
    RUN_TEST(test_acceleration_or_jerk_jumps);
    RUN_TEST(test_rate_is_not_the_slope_of_the_angle);
    RUN_TEST(test_profile_is_another);
    RUN_TEST(test_new_target_takes_over_half_way);
    RUN_TEST(test_move_in_no_time_jumps);
    RUN_TEST(test_rest_drifts);
    RUN_TEST(test_rate_of_a_long_move_is_not_the_mean_times_its_profile);
    RUN_TEST(test_brake_does_not_end_at_rest_in_time);
    RUN_TEST(test_brake_leaves_the_path_or_turns_back);
    RUN_TEST(test_brake_begins_or_ends_with_a_jump);
    RUN_TEST(test_braking_rate_is_not_the_slope_of_the_angle);
    RUN_TEST(test_brake_of_an_ending_move_overshoots_its_target);
    RUN_TEST(test_brake_at_rest_or_twice_changes_something);
    RUN_TEST(test_smooth_step_is_not_smooth);
    return UNITY_END();
}
