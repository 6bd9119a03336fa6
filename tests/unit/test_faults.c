/* The whole ECU (ecu/ecu) tick by tick: each fault of can_protocol/faults.toml, when it comes, what follows, how it is
 * left. */
#include <stdlib.h>

#include "can_protocol/generated/diarc_hash.h"
#include "ecu_bench.h"

void setUp(void)
{
    sensors_agree = false;
    power_on_with_period(1000);
}

void tearDown(void)
{
}

static void test_fault_too_early_or_never(void)
{
    /* GIVEN RUN WHEN any one sensor frame is missing for exactly 4 ticks THEN nothing; for 5 THEN a fault: a safe stop
     * begins in that very tick, an emergency goes out before its valve frame, and 0.2 s later FAULT, valves shut */
    for (uint8_t n = 0; n < 3u; n++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        for (int round = 0; round < 3; round++) { /* the count starts again with every good tick */
            sensors.silent[n] = true;
            ticks(WRONG_TICKS);
            sensors.silent[n] = false;
            tick();
            TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
        }
        sensors.silent[n] = true;
        ticks(WRONG_TICKS + 1);
        TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
        TEST_ASSERT_EQUAL_INT(FAULT_SENSOR_FRAMES_LOST, ecu.fault);
        TEST_ASSERT_EQUAL_HEX32(0x81, bus.sent[1].id);
        TEST_ASSERT_EQUAL_HEX32(0x8100, get_bits(bus.sent[1].data, 0, 16));
        TEST_ASSERT_EQUAL_HEX8(0x11, bus.sent[1].data[2]); /* generic, communication */
        TEST_ASSERT_EQUAL_UINT8(FAULT_SENSOR_FRAMES_LOST, bus.sent[1].data[3]);
        TEST_ASSERT_EQUAL_HEX32(1u << FAULT_SENSOR_FRAMES_LOST, get_bits(bus.sent[1].data, 32, 32));
        TEST_ASSERT_EQUAL_HEX32(0x202, bus.sent[2].id);
        for (int k = 1; k < STOP_TICKS; k++) {
            TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
            tick();
            TEST_ASSERT_NULL(sent(0x81)); /* once */
        }
        TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
        TEST_ASSERT_EQUAL_INT32(0, spool(SWING));
        TEST_ASSERT_EQUAL_UINT32(FAULT_SENSOR_FRAMES_LOST, get_bits(timing_page(0), 56, 8));
    }
}

static void make_invalid(unsigned what)
{
    switch (what) {
    case 0:
        sensors.status[0] = 15;
        break;
    case 1:
        sensors.status[1] = 15;
        break;
    case 2:
        sensors.status[2] = 15;
        break;
    case 3:
        sensors.angle[SWING] = -8388608;
        break;
    case 4:
        sensors.angle[WRIST] = -8388608;
        break;
    case 5:
        sensors.pressure[SWING][BORE] = 65535;
        break;
    case 6:
        sensors.pressure[WRIST][ANNULUS] = 65535;
        break;
    case 7:
        sensors.spool[SWING] = -32768;
        break;
    default:
        sensors.spool[WRIST] = -32768;
        break;
    }
}

static void test_invalid_sensor_value_used(void)
{
    /* GIVEN RUN WHEN a sensor says that it is invalid, in its status or by the reserved value THEN for 4
     * ticks the valves stay calm, and after 5 there is a fault that says so; calm through the safe stop as well */
    for (unsigned what = 0; what < 9; what++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        ticks(20);
        const int32_t before[JOINTS] = {spool(SWING), spool(WRIST)};
        make_invalid(what);
        for (int k = 0; k < WRONG_TICKS; k++) {
            tick();
            TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
            TEST_ASSERT_INT32_WITHIN(50, before[SWING], spool(SWING));
            TEST_ASSERT_INT32_WITHIN(50, before[WRIST], spool(WRIST));
        }
        tick();
        TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
        TEST_ASSERT_EQUAL_INT(FAULT_SENSOR_INVALID, ecu.fault);
        TEST_ASSERT_EQUAL_HEX32(0x5000, get_bits(sent(0x81)->data, 0, 16));
        while (ecu.mode == MODE_SAFE_STOP) {
            TEST_ASSERT_INT32_WITHIN(50 + abs(before[SWING]), 0, spool(SWING));
            TEST_ASSERT_INT32_WITHIN(50 + abs(before[WRIST]), 0, spool(WRIST));
            tick();
        }
        TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    }
}

static void test_degraded_sensor_taken_for_invalid(void)
{
    /* GIVEN RUN, and a machine whose pressures may be whatever the frame can say WHEN a sensor calls itself degraded,
     * or is at the last valid value THEN no fault */
    struct parameter_image image = default_parameter_image;
    image_set(&image, "supervision.pressure_range_Pa", 32767000);
    image_set(&image, "supervision.pressure_max_Pa", 32767000);
    image_set(&image, "supervision.pressure_step_Pa", 30000000);
    power_on(&image, 1000);
    to_run(CONTROLLER_DIARC);
    sensors.status[0] = sensors.status[1] = sensors.status[2] = 1;
    sensors.pressure[SWING][BORE] = 65534;
    sensors.spool[WRIST] = -32767;
    ticks(20);
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
    TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
}

static void test_fault_left_by_itself(void)
{
    /* GIVEN FAULT WHEN the sensors are good again THEN it stays, valves shut, RUN refused; only RESET_FAULT
     * leaves it, to STANDBY */
    to_fault();
    TEST_ASSERT_FALSE(ecu.controller.armed);
    ticks(50);
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    queue_request(REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    TEST_ASSERT_EQUAL_INT(REFUSAL_NOT_IN_STANDBY, ecu.counters.last_refusal);
    queue_request(REQUEST_RESET_FAULT, 0, 0, 0, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    TEST_ASSERT_EQUAL_INT(FAULT_NONE, ecu.fault);
    TEST_ASSERT_EQUAL_UINT32(FAULT_NONE, get_bits(timing_page(0), 56, 8));
}

static void test_end_of_a_fault_not_told(void)
{
    /* GIVEN FAULT WHEN it is reset THEN one emergency with code 0, as the DBC promises */
    to_fault();
    tick();
    queue_request(REQUEST_RESET_FAULT, 0, 0, 0, 1);
    tick();
    const struct can_frame_11bit *const emergency = sent(0x81);
    TEST_ASSERT_NOT_NULL(emergency);
    TEST_ASSERT_EQUAL_HEX32(0, get_bits(emergency->data, 0, 16));
    TEST_ASSERT_EQUAL_HEX8(0, emergency->data[2]);
    tick();
    TEST_ASSERT_NULL(sent(0x81));
}

static void test_lost_angle_kicks_the_valve(void)
{
    /* GIVEN a move that is followed exactly WHEN encoder frames are lost in the middle of it THEN the valve
     * frames differ little from those without the loss: the angle is predicted, not held */
    int32_t with[3];
    for (int lost = 0; lost < 2; lost++) {
        setUp();
        to_run(CONTROLLER_PID);
        sensors.follow = true;
        queue_request(REQUEST_MOVE, SWING, 0, 0.7, 1000);
        for (int k = 0; k < 503; k++) {
            tick();
            sensors.silent[0] = lost == 1 && k >= 499 && k < 502;
            if (k >= 500) {
                if (lost == 0) {
                    with[k - 500] = spool(SWING);
                } else {
                    TEST_ASSERT_INT32_WITHIN(10, with[k - 500], spool(SWING));
                }
            }
        }
    }
}

static void test_late_answers_taken(void)
{
    /* GIVEN RUN WHEN the sensor frames come one tick late, again and again THEN they are refused and it is a
     * fault that says so */
    to_run(CONTROLLER_DIARC);
    for (int k = 0; k < WRONG_TICKS + 1; k++) {
        bus.sent_count = 0;
        ecu.sync_counter = ecu.sync_counter == 0 ? 240 : ecu.sync_counter;
        queue_sensors(); /* answers the SYNC before */
        ecu_tick_begin(&ecu, &PORT);
        TEST_ASSERT_FALSE(ecu_tick_receive(&ecu, &PORT));
        ecu_tick_end(&ecu, &PORT);
    }
    TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
    TEST_ASSERT_EQUAL_INT(FAULT_SENSOR_FRAMES_CORRUPT, ecu.fault);
    TEST_ASSERT_EQUAL_UINT16(5, ecu.counters.late_ticks);
    TEST_ASSERT_EQUAL_UINT8(15, ecu.receive.refused);
}

/* ---- each fault of can_protocol/faults.toml ---- */

enum { DEGRADES, SAFE_STOPS, VALVES_OFF };
enum { GENERIC = 0x01, COMMUNICATION = 0x10, DEVICE = 0x20, MANUFACTURER = 0x80 };

/* Written down again, from the text of faults.toml. */
static const struct expected_fault {
    uint16_t emergency;
    uint8_t error_register;
    uint8_t reaction;
} EXPECTED[FAULTS] = {
    [1] = {0x8100, COMMUNICATION, SAFE_STOPS},  [2] = {0x5000, DEVICE, SAFE_STOPS},
    [3] = {0x8110, COMMUNICATION, SAFE_STOPS},  [4] = {0x5010, DEVICE, SAFE_STOPS},
    [5] = {0x5020, DEVICE, SAFE_STOPS},         [6] = {0x5030, DEVICE, SAFE_STOPS},
    [7] = {0xFF07, MANUFACTURER, DEGRADES},     [8] = {0xFF08, MANUFACTURER, SAFE_STOPS},
    [9] = {0xFF09, MANUFACTURER, SAFE_STOPS},   [10] = {0xFF0A, MANUFACTURER, DEGRADES},
    [11] = {0xFF0B, MANUFACTURER, SAFE_STOPS},  [12] = {0xFF0C, MANUFACTURER, SAFE_STOPS},
    [13] = {0xFF0D, MANUFACTURER, DEGRADES},    [14] = {0xFF0E, MANUFACTURER, SAFE_STOPS},
    [15] = {0xFF0F, MANUFACTURER, VALVES_OFF},  [16] = {0xFF10, COMMUNICATION, VALVES_OFF},
    [17] = {0x6300, DEVICE, VALVES_OFF},        [18] = {0x8130, COMMUNICATION, SAFE_STOPS},
    [19] = {0x8140, COMMUNICATION, VALVES_OFF}, [20] = {0xFF14, DEVICE, SAFE_STOPS},
    [21] = {0xFF15, DEVICE, SAFE_STOPS},
};

static double limit_of(const char *name)
{
    char full[64];
    (void)snprintf(full, sizeof full, "supervision.%s", name);
    return default_value(full);
}

/* Pa to raw, to the raw step below or above. */
static uint16_t below_Pa(double Pa)
{
    return (uint16_t)(lround(Pa / 500) - 2);
}

static uint16_t above_Pa(double Pa)
{
    return (uint16_t)(lround(Pa / 500) + 2);
}

static void expect_none(unsigned count)
{
    const enum ecu_mode mode = ecu.mode;
    for (unsigned k = 0; k < count; k++) {
        tick();
        TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
        TEST_ASSERT_EQUAL_INT(mode, ecu.mode);
        TEST_ASSERT_NULL(sent(0x81));
    }
}

/* The EMCY of this tick is that of the fault, alone. */
static void expect_emergency(enum ecu_fault fault)
{
    TEST_ASSERT_EQUAL_UINT(1, count_sent(0x81));
    const uint8_t *const d = sent(0x81)->data;
    TEST_ASSERT_EQUAL_HEX32(EXPECTED[fault].emergency, get_bits(d, 0, 16));
    TEST_ASSERT_EQUAL_HEX8(GENERIC | EXPECTED[fault].error_register, d[2]);
    TEST_ASSERT_EQUAL_UINT8(fault, d[3]);
    TEST_ASSERT_EQUAL_HEX32(1u << fault, get_bits(d, 32, 32));
}

/* The next tick raises this fault, alone; its reaction is seen to its end: FAULT, or the mode as it was. */
static void expect_fault(enum ecu_fault fault)
{
    const enum ecu_mode mode = ecu.mode;
    const bool drove = opens_valves(mode);
    TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
    tick();
    TEST_ASSERT_EQUAL_HEX32(1u << fault, ecu.active_faults);
    TEST_ASSERT_EQUAL_INT(fault, ecu.fault);
    expect_emergency(fault);
    if (EXPECTED[fault].reaction == DEGRADES) {
        TEST_ASSERT_EQUAL_INT(mode, ecu.mode);
        TEST_ASSERT_TRUE(ecu.controller.estimator.held);
        return;
    }
    if (EXPECTED[fault].reaction == SAFE_STOPS) {
        TEST_ASSERT_TRUE(drove);
        for (int k = 1; k < STOP_TICKS; k++) {
            TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
            tick();
            TEST_ASSERT_EQUAL_HEX32(1u << fault, ecu.active_faults);
            TEST_ASSERT_NULL(sent(0x81));
        }
    }
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode); /* watch_valves: zero and disabled */
    TEST_ASSERT_FALSE(ecu.controller.armed);
}

static void expect_reset(void)
{
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    ask(REQUEST_RESET_FAULT);
    tick();
    TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
    TEST_ASSERT_EQUAL_INT(FAULT_NONE, ecu.fault);
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    TEST_ASSERT_EQUAL_UINT(1, count_sent(0x81));
    TEST_ASSERT_EQUAL_HEX32(0, get_bits(sent(0x81)->data, 0, 32));
    TEST_ASSERT_EQUAL_HEX32(0, get_bits(sent(0x81)->data, 32, 32));
}

static void expect_reset_refused(enum ecu_refusal reason)
{
    const uint32_t active = ecu.active_faults;
    ask(REQUEST_RESET_FAULT);
    expect_refusal(reason);
    TEST_ASSERT_EQUAL_HEX32(active, ecu.active_faults);
    TEST_ASSERT_NULL(sent(0x81));
}

static void run_again(void)
{
    ask(REQUEST_RUN);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
}

static void test_fault_table_says_something_else(void)
{
    /* GIVEN the generated table WHEN compared THEN codes, register bits and reactions are those of the text */
    for (int k = 1; k < FAULTS; k++) {
        TEST_ASSERT_EQUAL_HEX16(EXPECTED[k].emergency, fault_table[k].emergency);
        TEST_ASSERT_EQUAL_HEX8(EXPECTED[k].error_register, fault_table[k].error_register & ~GENERIC);
        TEST_ASSERT_EQUAL_UINT8(EXPECTED[k].reaction, fault_table[k].reaction);
    }
}

static void test_cause_of_wrong_sensors_not_the_last_of_them(void)
{
    /* GIVEN four ticks of invalid sensors WHEN in the fifth the frames are lost, corrupt, or two things are wrong at once
     * THEN the fault names the fifth tick's, of two the one that says more of the sensor */
    static const struct {
        unsigned silent, corrupt, invalid; /* frames, one bit each */
        enum ecu_fault fault;
    } fifth[] = {
        {1, 0, 0, FAULT_SENSOR_FRAMES_LOST},    {4, 0, 0, FAULT_SENSOR_FRAMES_LOST},
        {2, 2, 0, FAULT_SENSOR_FRAMES_CORRUPT}, {1 | 2, 2, 0, FAULT_SENSOR_FRAMES_CORRUPT},
        {1, 0, 4, FAULT_SENSOR_INVALID},        {2, 2, 1, FAULT_SENSOR_INVALID},
    };
    for (unsigned n = 0; n < COUNT_OF(fifth); n++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        sensors.status[1] = 15;
        expect_none(WRONG_TICKS);
        for (unsigned k = 0; k < 3; k++) {
            sensors.silent[k] = ((fifth[n].silent >> k) & 1u) != 0u;
            sensors.status[k] = ((fifth[n].invalid >> k) & 1u) != 0u ? 15 : 0;
            if (((fifth[n].corrupt >> k) & 1u) != 0u) {
                static const uint16_t ids[] = {0x182, 0x282, 0x382};
                struct can_frame_11bit bad = protected_frame(ids[k], 0);
                bad.data[5] ^= 4u;
                queue(bad);
            }
        }
        tick();
        TEST_ASSERT_EQUAL_INT(fifth[n].fault, ecu.fault);
        expect_emergency(fifth[n].fault);
    }
}

static void test_frame_refused_by_length_crc_or_counter_taken(void)
{
    /* GIVEN RUN WHEN a sensor's frames come with a wrong length, CRC or counter THEN 4 ticks nothing, in the fifth
     * SENSOR_FRAMES_CORRUPT; reset once good frames come again, not before */
    for (int what = 0; what < 3; what++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        sensors.silent[1] = true;
        for (int k = 0; k <= WRONG_TICKS; k++) {
            const uint8_t counter = (uint8_t)((ecu.sync_counter + (what == 2 ? 1u : 0u)) % 15u);
            struct can_frame_11bit bad = protected_frame(0x282, counter);
            bad.length = what == 0 ? 7 : 8;
            bad.data[3] ^= what == 1 ? 1u : 0u;
            queue(bad);
            if (k < WRONG_TICKS) {
                expect_none(1);
            }
        }
        expect_fault(FAULT_SENSOR_FRAMES_CORRUPT);
        expect_reset_refused(REFUSAL_SENSORS_NOT_FRESH);
        sensors.silent[1] = false;
        tick();
        expect_reset();
    }
}

static void test_pressure_out_of_range_used_or_a_legal_one_refused(void)
{
    /* GIVEN each chamber of a machine that stands any pressure its sensors can tell WHEN it is at the end of the range
     * THEN nothing; beyond it for 4 ticks nothing, in the fifth SENSOR_RANGE; RESET_FAULT once it is back */
    struct parameter_image image = default_parameter_image;
    image_set(&image, "supervision.pressure_max_Pa", 32767000);
    image_set(&image, "supervision.pressure_step_Pa", 30000000);
    const double range_Pa = limit_of("pressure_range_Pa");
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        uint16_t *const pressure = &sensors.pressure[n / CHAMBERS][n % CHAMBERS];
        power_on(&image, 1000);
        to_run(CONTROLLER_DIARC);
        *pressure = below_Pa(range_Pa);
        expect_none(20);
        *pressure = above_Pa(range_Pa);
        expect_none(WRONG_TICKS);
        expect_fault(FAULT_SENSOR_RANGE);
        expect_reset_refused(REFUSAL_SENSORS_NOT_FRESH);
        *pressure = below_Pa(range_Pa);
        tick();
        expect_reset();
    }
}

static void test_angle_where_no_arm_can_be_used(void)
{
    /* GIVEN each joint near either end WHEN its angle is just less than 0.2 rad outside THEN nothing; just more, for 4
     * ticks nothing, in the fifth SENSOR_RANGE. From there no STANDBY is reached either */
    static const double ends_rad[] = {-1.0, 1.2}; /* of both joints */
    for (unsigned n = 0; n < 2u * JOINTS; n++) {
        const enum joint i = n % 2u == 0u ? SWING : WRIST;
        const double end_rad = ends_rad[n / 2u];
        const double out = end_rad > 0 ? 1 : -1;
        setUp();
        sensors.angle[i] =
            angle_raw(end_rad + out * 0.1995); /* armed there, so that the soft limit is farther out */
        to_run(CONTROLLER_DIARC);
        sensors.angle[i] = angle_raw(end_rad + out * 0.1999);
        expect_none(20);
        sensors.angle[i] = angle_raw(end_rad + out * 0.2001);
        expect_none(WRONG_TICKS);
        expect_fault(FAULT_SENSOR_RANGE);
        expect_reset_refused(REFUSAL_SENSORS_NOT_FRESH);
        setUp();
        sensors.angle[i] = angle_raw(end_rad + out * 0.2001);
        queue_nmt(NMT_START, 1);
        ticks(10);
        TEST_ASSERT_EQUAL_INT(MODE_INIT, ecu.mode);
    }
}

static void test_angle_faster_than_any_arm_used(void)
{
    /* GIVEN RUN WHEN an angle moves at just less than its fastest for 30 ticks THEN nothing; WHEN it jumps THEN for 4
     * ticks the valves stay where they are and in the fifth SENSOR_RATE; RESET_FAULT, RUN where it is now */
    for (uint8_t i = 0; i < JOINTS; i++) {
        const double rate = limit_of(i == SWING ? "swing.rate_rad_s" : "wrist.rate_rad_s");
        setUp();
        to_run(CONTROLLER_PID);
        const int32_t step = angle_raw(rate * 0.999e-3);
        for (int k = 0; k < 20; k++) {
            sensors.angle[i] += k < 10 ? step : -step;
            expect_none(1);
        }
        ticks(300);
        TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
        const int32_t before = spool((enum joint)i);
        sensors.angle[i] += angle_raw(0.05);
        for (int k = 0; k < WRONG_TICKS; k++) {
            expect_none(1);
            TEST_ASSERT_INT32_WITHIN(30, before, spool((enum joint)i));
        }
        expect_fault(FAULT_SENSOR_RATE);
        expect_reset();
        run_again();
        expect_none(20);
    }
}

static void test_angle_just_too_fast_used(void)
{
    /* GIVEN RUN at rest WHEN an angle jumps by 1 % more than its fastest THEN that sample is wrong; by 1 % less it is not
     */
    for (uint8_t i = 0; i < JOINTS; i++) {
        const double rate = limit_of(i == SWING ? "swing.rate_rad_s" : "wrist.rate_rad_s");
        for (int sign = -1; sign <= 1; sign += 2) {
            setUp();
            to_run(CONTROLLER_PID);
            ticks(5);
            const int32_t rest = sensors.angle[i];
            sensors.angle[i] = rest + sign * angle_raw(rate * 0.99e-3);
            tick();
            TEST_ASSERT_EQUAL_UINT8(0, ecu.supervision.sensors_wrong);
            setUp();
            to_run(CONTROLLER_PID);
            ticks(5);
            sensors.angle[i] = rest + sign * angle_raw(rate * 1.01e-3);
            tick();
            TEST_ASSERT_EQUAL_UINT8(1, ecu.supervision.sensors_wrong);
            sensors.angle[i] = rest;
            tick();
            TEST_ASSERT_EQUAL_UINT8(0, ecu.supervision.sensors_wrong);
        }
    }
}

static void test_angle_that_stopped_the_arm_moves_the_estimate(void)
{
    /* GIVEN a move with true sensors, and an estimate that follows WHEN an encoder jumps by 0.5 rad and stays there, which
     * stops the arm THEN not a bit of the estimate moves from the stop on, nor when the angle comes back */
    for (uint8_t i = 0; i < JOINTS; i++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        sensors.follow = true;
        queue_request(REQUEST_MOVE, i, 0, 0.5, 800);
        ticks(600);
        TEST_ASSERT_TRUE(ecu.controller.estimator.updating);
        sensors.follow = false;
        const int32_t before = sensors.angle[i];
        sensors.angle[i] = before - angle_raw(0.5);
        ticks(WRONG_TICKS + 1);
        TEST_ASSERT_EQUAL_HEX32(1u << FAULT_SENSOR_RATE, ecu.active_faults);
        const struct estimator held = ecu.controller.estimator;
        for (int k = 0; k < 2 * STOP_TICKS; k++) {
            sensors.angle[i] = k < STOP_TICKS + 20 ? sensors.angle[i] : before;
            tick();
            TEST_ASSERT_EQUAL_MEMORY(held.theta_m, ecu.controller.estimator.theta_m, sizeof held.theta_m);
            TEST_ASSERT_EQUAL_MEMORY(held.theta_h, ecu.controller.estimator.theta_h, sizeof held.theta_h);
        }
    }
}

static void test_noise_that_is_refused_sneaks_in(void)
{
    /* GIVEN RUN at rest WHEN the encoder jumps, refused, and then says a half of what it might move in a tick THEN that is
     * refused as well; a fifth of it THEN taken, and then the half is taken again */
    for (uint8_t i = 0; i < JOINTS; i++) {
        setUp();
        to_run(CONTROLLER_PID);
        ticks(20);
        const int32_t rest = sensors.angle[i];
        const double most_rad =
            default_value(i == SWING ? "supervision.swing.rate_rad_s" : "supervision.wrist.rate_rad_s") *
            1e-3;
        sensors.angle[i] = rest + angle_raw(0.1);
        tick();
        TEST_ASSERT_EQUAL_UINT8(1, ecu.supervision.sensors_wrong);
        sensors.angle[i] = rest + angle_raw(most_rad / 2);
        tick();
        TEST_ASSERT_EQUAL_UINT8(2, ecu.supervision.sensors_wrong);
        sensors.angle[i] = rest + angle_raw(most_rad / 5);
        tick();
        TEST_ASSERT_EQUAL_UINT8(0, ecu.supervision.sensors_wrong);
        sensors.angle[i] = rest + angle_raw(most_rad / 5 + most_rad / 2);
        tick();
        TEST_ASSERT_EQUAL_UINT8(0, ecu.supervision.sensors_wrong);
    }
}

static void test_pressure_that_jumps_used(void)
{
    /* GIVEN RUN WHEN a pressure changes by just less than its step, to and fro, THEN nothing; by just more, and stays,
     * for 4 ticks nothing and in the fifth SENSOR_RATE; RESET_FAULT takes it as it is now */
    const uint16_t step = (uint16_t)lround(limit_of("pressure_step_Pa") / 500);
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        uint16_t *const pressure = &sensors.pressure[n / CHAMBERS][n % CHAMBERS];
        setUp();
        to_run(CONTROLLER_PID);
        for (int k = 0; k < 10; k++) {
            *pressure = (uint16_t)(k % 2 == 0 ? *pressure + (step - 2) : *pressure - (step - 2));
            expect_none(1);
        }
        *pressure = (uint16_t)(*pressure + step + 2);
        expect_none(WRONG_TICKS);
        expect_fault(FAULT_SENSOR_RATE);
        expect_reset();
        run_again();
        expect_none(20);
    }
}

static void test_pressure_after_lost_frames_taken_for_a_jump(void)
{
    /* GIVEN RUN WHEN three ticks' frames are lost and the pressure has changed meanwhile by less than four steps THEN it
     * is taken; by more THEN it is wrong. After values that were refused it has only a quarter of a step */
    const int32_t step = (int32_t)lround(limit_of("pressure_step_Pa") / 500);
    for (int much = 0; much < 2; much++) {
        setUp();
        sensors.pressure[SWING][BORE] = 400;
        to_run(CONTROLLER_PID);
        silence(true);
        ticks(3);
        silence(false);
        sensors.pressure[SWING][BORE] = (uint16_t)(400 + 4 * step + (much == 1 ? 8 : -8));
        tick();
        TEST_ASSERT_EQUAL_UINT8(much == 1 ? 4 : 0, ecu.supervision.sensors_wrong);
        TEST_ASSERT_EQUAL_INT32(much == 1 ? 400 : 400 + 4 * step - 8, ecu.samples.pressure[SWING][BORE]);
    }
    setUp();
    to_run(CONTROLLER_PID);
    const uint16_t before = sensors.pressure[SWING][BORE];
    sensors.pressure[SWING][BORE] = (uint16_t)(before + step + 8);
    ticks(3);
    TEST_ASSERT_EQUAL_UINT8(3, ecu.supervision.sensors_wrong);
    sensors.pressure[SWING][BORE] = (uint16_t)(before + step / 4 + 8);
    tick();
    TEST_ASSERT_EQUAL_UINT8(4, ecu.supervision.sensors_wrong);
    sensors.pressure[SWING][BORE] = (uint16_t)(before + step / 4 - 8);
    tick();
    TEST_ASSERT_EQUAL_UINT8(0, ecu.supervision.sensors_wrong);
}

static void test_single_spike_reaches_the_law(void)
{
    /* GIVEN a move WHEN one sample of any sensor is out of range, too fast, invalid, lost or corrupt THEN the valves go on
     * as without it, to within what one predicted or kept sample makes */
    enum { AT = 300, LAST = 320 };
    for (uint8_t controller = 0; controller < CONTROLLERS; controller++) {
        static int32_t without[LAST][JOINTS];
        for (int spike = 0; spike < 10; spike++) {
            setUp();
            to_run(controller);
            sensors.follow = true;
            queue_request(REQUEST_MOVE, SWING, 0, 0.5, 1000);
            queue_request(REQUEST_MOVE, WRIST, 0, -0.3, 1000);
            for (int k = 0; k < LAST; k++) {
                uint16_t pressure[JOINTS][CHAMBERS];
                memcpy(pressure, sensors.pressure, sizeof pressure);
                if (k == AT) {
                    sensors.angle[SWING] += spike == 1 ? angle_raw(0.1) : (spike == 2 ? angle_raw(2) : 0);
                    sensors.angle[WRIST] -= spike == 3 ? angle_raw(0.02) : 0;
                    sensors.status[0] = spike == 4 ? 15 : 0;
                    sensors.silent[0] = spike == 5;
                    sensors.pressure[SWING][BORE] =
                        (uint16_t)(pressure[SWING][BORE] + (spike == 6 ? 9000 : 0)); /* 45 bar */
                    sensors.pressure[WRIST][ANNULUS] =
                        spike == 7 ? 60000 : pressure[WRIST][ANNULUS]; /* 300 bar */
                    sensors.silent[2] = spike == 8;
                    sensors.status[1] = spike == 9 ? 15 : 0;
                }
                tick();
                if (k == AT) {
                    TEST_ASSERT_EQUAL_UINT8(spike == 0 ? 0 : 1, ecu.supervision.sensors_wrong);
                    silence(false);
                    memset(sensors.status, 0, sizeof sensors.status);
                    memcpy(sensors.pressure, pressure, sizeof pressure);
                }
                for (uint8_t i = 0; i < JOINTS; i++) {
                    if (spike == 0) {
                        without[k][i] = spool((enum joint)i);
                    } else {
                        TEST_ASSERT_INT32_WITHIN(120, without[k][i], spool((enum joint)i)); /* 0.7 % */
                    }
                }
            }
            TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
        }
    }
}

static void test_stuck_encoder_not_noticed(void)
{
    /* GIVEN a move WHEN an encoder stays at its raw value THEN SENSOR_STUCK as soon as the reference has gone 0.003 rad,
     * to the tick, also when frames are lost meanwhile; at rest, for as long as one likes, nothing */
    const double limit_rad = limit_of("stuck_rad");
    for (uint8_t n = 0; n < 2u * JOINTS; n++) {
        const uint8_t i = n % JOINTS;
        const bool loses = n >= JOINTS;
        setUp();
        to_run(CONTROLLER_PID);
        expect_none(3000);
        sensors.follow = true;
        queue_request(REQUEST_MOVE, i, 0, 0.4, 1000);
        ticks(300);
        TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
        sensors.stuck_angle[i] = true;
        tick(); /* the last value that has changed */
        double travel_rad = 0;
        for (int k = 0; k < 100; k++) {
            const double step_rad = fabs(real(trajectory_now(&ecu.controller.trajectory[i]).w)) * 1e-3;
            if (travel_rad + step_rad > limit_rad) {
                break;
            }
            travel_rad += step_rad;
            silence(loses && k % 2 == 0 && travel_rad < 0.8 * limit_rad);
            expect_none(1);
            silence(false);
        }
        TEST_ASSERT_TRUE(travel_rad > 0.5 * limit_rad);
        sensors.stuck_angle[i] = true;
        expect_fault(FAULT_SENSOR_STUCK);
        sensors.stuck_angle[i] = false;
        expect_reset();
    }
}

static void test_slow_encoder_taken_for_stuck(void)
{
    /* GIVEN a move WHEN the encoder changes by one raw step each time before the reference has gone 0.003 rad THEN no
     * fault, and none for a tick whose frame is lost meanwhile */
    to_run(CONTROLLER_PID);
    sensors.follow = true;
    queue_request(REQUEST_MOVE, SWING, 0, 0.2, 1000);
    ticks(200);
    sensors.stuck_angle[SWING] = true;
    double travel_rad = 0;
    for (int k = 0; k < 600; k++) {
        travel_rad += fabs(real(trajectory_now(&ecu.controller.trajectory[SWING]).w)) * 1e-3;
        if (travel_rad > 0.0027) {
            sensors.angle[SWING]++;
            travel_rad = 0;
        }
        sensors.silent[0] = k == 50;
        tick();
        TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
        TEST_ASSERT_FALSE(fault_active(&ecu, FAULT_SENSOR_STUCK));
    }
}

static void test_stuck_pressure_not_noticed_or_a_still_one_taken_for_it(void)
{
    /* GIVEN a move WHEN a pressure's raw value stays while the joint's reference moves THEN SENSOR_STUCK after 40 ms to
     * the tick; with a raw step's change in the 40th tick nothing; nor while the reference rests or creeps, nor by the
     * other joint's motion */
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        const uint8_t i = n / CHAMBERS;
        const uint8_t c = n % CHAMBERS;
        setUp();
        to_run(CONTROLLER_PID);
        sensors.follow = true;
        sensors.stuck_pressure[i][c] = true;
        queue_request(REQUEST_MOVE, (uint8_t)(1 - i), 0, 0.4, 1000);
        queue_request(REQUEST_MOVE, i, 0, 0.101, 1000); /* no faster than 2.2 mrad/s */
        expect_none(1000);
        queue_request(REQUEST_MOVE, i, 0, 0.5, 1000);
        sensors.stuck_pressure[i][c] = false;
        expect_none(300);
        sensors.stuck_pressure[i][c] = true;
        expect_none(39);
        sensors.pressure[i][c] = (uint16_t)(sensors.pressure[i][c] ^ 1u);
        expect_none(40);
        expect_fault(FAULT_SENSOR_STUCK);
    }
}

/* A change of mode is none of a degrading fault's business; it goes a second after its cause. */
static void expect_gone_after_a_second(enum ecu_fault fault)
{
    const enum ecu_mode mode = ecu.mode;
    for (int k = 0; k < SECOND_TICKS; k++) {
        tick();
        TEST_ASSERT_TRUE(fault_active(&ecu, fault));
        TEST_ASSERT_TRUE(ecu.controller.estimator.held);
        TEST_ASSERT_NULL(sent(0x81));
    }
    tick();
    TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
    TEST_ASSERT_EQUAL_INT(FAULT_NONE, ecu.fault);
    TEST_ASSERT_FALSE(ecu.controller.estimator.held);
    TEST_ASSERT_EQUAL_HEX32(0, get_bits(sent(0x81)->data, 0, 32));
    TEST_ASSERT_EQUAL_INT(mode, ecu.mode);
}

static void test_contradicting_sensors_not_noticed(void)
{
    /* GIVEN RUN WHEN a joint's innovations have been too large 24 times in a row THEN nothing, 25 times THEN
     * MODEL_MISMATCH for a second, the estimate held; tried again from 0 */
    const uint8_t most = (uint8_t)limit_of("mismatch_updates");
    for (uint8_t i = 0; i < JOINTS; i++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        ecu.controller.estimator.hydraulics[i].strikes = (uint8_t)(most - 1u);
        expect_none(10);
        ecu.controller.estimator.hydraulics[i].strikes = most;
        expect_fault(FAULT_MODEL_MISMATCH);
        TEST_ASSERT_EQUAL_UINT8(0, ecu.controller.estimator.hydraulics[i].strikes);
        expect_gone_after_a_second(FAULT_MODEL_MISMATCH);
        expect_none(100);
    }
}

static void test_spool_that_lies_moves_the_estimate(void)
{
    /* GIVEN a move of 3 s that begins with sensors in agreement WHEN the spool then says the opposite THEN
     * MODEL_MISMATCH, and from then on not a bit of the estimate moves; the arm goes on; EstimateHeld says so */
    to_run(CONTROLLER_DIARC);
    sensors.follow = true;
    queue_request(REQUEST_MOVE, SWING, 0, 1.1, 3000);
    expect_none(700);
    unsigned k = 0;
    for (; k < 500 && ecu.active_faults == 0u; k++) {
        sensors.spool[SWING] = (int16_t)-sensors.spool[SWING];
        tick();
    }
    TEST_ASSERT_EQUAL_HEX32(1u << FAULT_MODEL_MISMATCH, ecu.active_faults);
    TEST_ASSERT_TRUE(k >= 25u * 4u); /* one update of the swing's hydraulics every 4 ticks */
    expect_emergency(FAULT_MODEL_MISMATCH);
    const struct estimator before = ecu.controller.estimator;
    for (k = 0; k < 500; k++) {
        sensors.spool[SWING] = (int16_t)-sensors.spool[SWING];
        tick();
        TEST_ASSERT_EQUAL_MEMORY(before.theta_m, ecu.controller.estimator.theta_m, sizeof before.theta_m);
        TEST_ASSERT_EQUAL_MEMORY(before.theta_h, ecu.controller.estimator.theta_h, sizeof before.theta_h);
    }
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
    TEST_ASSERT_TRUE(trajectory_moving(&ecu.controller.trajectory[SWING]));
    TEST_ASSERT_EQUAL_UINT32(1, get_bits(wait_for(0x181, 0, 8, -1), 61, 1));
}

/* Spool and pressures of a joint at rest say that the oil moves it at this rate, rad/s. */
static void let_oil_pass(enum joint i, double w)
{
    sensors.spool[i] = steady_spool(i, from_real(0.1), from_real(w));
}

static void test_encoder_that_contradicts_the_oil_believed(void)
{
    /* GIVEN RUN at rest WHEN spool and pressures say a joint moves at 0.168 rad/s THEN nothing, for that is within the limit
     * and a quarter; 0.21 THEN SENSORS_CONTRADICT within 10 windows of 4 ticks, 0.5 within 3, either way; and after a
     * reset nothing is left of it */
    static const double slow = 0.168;
    static const double fast[] = {0.21, 0.5};
    static const unsigned within[] = {40, 12};
    for (unsigned n = 0; n < 8; n++) {
        const enum joint i = n % 2u == 0u ? SWING : WRIST;
        const double sign = n / 4u == 0u ? 1 : -1;
        setUp();
        ecu.machine.limits.contradiction = from_real(limit_of("contradiction_rad_s"));
        to_run(CONTROLLER_PID);
        expect_none(20);
        let_oil_pass(i, sign * slow);
        expect_none(400);
        let_oil_pass(i, 0);
        expect_none(200);
        let_oil_pass(i, sign * fast[n / 2u % 2u]);
        unsigned k = 0;
        for (; k < 100u && ecu.active_faults == 0u; k++) {
            tick();
        }
        TEST_ASSERT_EQUAL_HEX32(1u << FAULT_SENSORS_CONTRADICT, ecu.active_faults);
        TEST_ASSERT_TRUE(k <= within[n / 2u % 2u] + 4u);
        expect_emergency(FAULT_SENSORS_CONTRADICT);
        TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
        ticks(STOP_TICKS);
        let_oil_pass(i, 0);
        ticks(10);
        expect_reset();
        run_again();
        expect_none(200);
    }
}

static void test_move_with_true_sensors_taken_for_a_contradiction(void)
{
    /* GIVEN sensors of an arm that does as it is told WHEN both joints move, with every twentieth tick's frames lost, THEN
     * neither the encoder nor the spool is doubted */
    sensors_agree = true;
    power_on_with_period(1000);
    ecu.machine.limits.spool_error = from_real(limit_of("spool_error"));
    to_run(CONTROLLER_DIARC);
    sensors.follow = true;
    queue_request(REQUEST_MOVE, SWING, 0, 0.9, 1500);
    queue_request(REQUEST_MOVE, WRIST, 0, 0.5, 1500);
    for (int k = 0; k < 1600; k++) {
        silence(k % 20 == 7);
        tick();
        TEST_ASSERT_FALSE(fault_active(&ecu, FAULT_SENSORS_CONTRADICT));
        TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
    }
}

static void test_spool_elsewhere_than_it_was_sent_driven_on(void)
{
    /* GIVEN RUN at rest, the spools in the middle WHEN a spool says that it is 0.3 of its travel from its set-point THEN
     * nothing; just farther for 9 ticks nothing, for 10 VALVE_NOT_FOLLOWING */
    const double limit = limit_of("spool_error");
    for (unsigned n = 0; n < 4; n++) {
        const uint8_t i = (uint8_t)(n % 2u);
        const double sign = n / 2u == 0u ? 1 : -1;
        setUp();
        ecu.machine.limits.spool_error = from_real(limit);
        to_run(CONTROLLER_PID);
        const int32_t command = (int32_t)lround(real(ecu.controller.output[i].u) * 16384);
        const int32_t far = command + (int32_t)lround(sign * (limit * 16384 + 3));
        const int32_t near = command + (int32_t)lround(sign * (limit * 16384 - 3));
        sensors.spool[i] = (int16_t)near;
        expect_none(50);
        for (int round = 0; round < 2; round++) {
            sensors.spool[i] = (int16_t)far;
            expect_none(9);
            sensors.spool[i] = (int16_t)near;
            expect_none(1);
        }
        sensors.spool[i] = (int16_t)far;
        expect_none(9);
        expect_fault(FAULT_VALVE_NOT_FOLLOWING);
    }
}

static void test_loads_that_change_too_often_believed(void)
{
    /* GIVEN RUN WHEN a changed load is noticed twice within a second THEN nothing, three times THEN MODEL_MISMATCH; and
     * twice in each of several seconds nothing */
    to_run(CONTROLLER_DIARC);
    for (int k = 0; k < 4; k++) {
        ecu.controller.estimator.reopened = (uint16_t)(ecu.controller.estimator.reopened + 2u);
        expect_none(SECOND_TICKS);
    }
    ecu.controller.estimator.reopened = (uint16_t)(ecu.controller.estimator.reopened + 2u);
    expect_none(10);
    ecu.controller.estimator.reopened++;
    expect_fault(FAULT_MODEL_MISMATCH);
    expect_gone_after_a_second(FAULT_MODEL_MISMATCH);
}

static void test_joint_beyond_its_soft_limit_driven_on(void)
{
    /* GIVEN RUN near either end of either joint WHEN the angle is just inside the margin THEN nothing; just outside for 2
     * ticks, again and again, nothing; for 3 JOINT_LIMIT. After RESET_FAULT and RUN it may stay, and come back: only
     * farther out it is a fault again */
    static const double ends_rad[] = {-1.0, 1.2};
    const double margin_rad = limit_of("angle_margin_rad");
    for (unsigned n = 0; n < 2u * JOINTS; n++) {
        const enum joint i = n % 2u == 0u ? SWING : WRIST;
        const double end_rad = ends_rad[n / 2u];
        const double out = end_rad > 0 ? 1 : -1;
        const int32_t inside = angle_raw(end_rad + out * (margin_rad - 2e-6));
        const int32_t outside = angle_raw(end_rad + out * (margin_rad + 2e-6));
        setUp();
        sensors.angle[i] = angle_raw(end_rad - out * 1e-3);
        to_run(CONTROLLER_DIARC);
        push(i, out * margin_rad);
        sensors.angle[i] = inside;
        expect_none(20);
        for (int k = 0; k < 9; k++) {
            sensors.angle[i] = k % 3 == 0 ? inside : outside;
            expect_none(1);
        }
        sensors.angle[i] = inside;
        expect_none(1);
        sensors.angle[i] = outside;
        expect_none(OUTSIDE_TICKS - 1);
        expect_fault(FAULT_JOINT_LIMIT);
        expect_reset();
        run_again();
        expect_none(20);
        push(i, out * (margin_rad + 1e-3));
        expect_none(1);
        expect_fault(FAULT_JOINT_LIMIT);
    }
}

static void test_over_pressure_driven_on(void)
{
    /* GIVEN RUN WHEN a chamber is at the limit THEN nothing; just above it for 2 ticks nothing, for 3 OVER_PRESSURE.
     * RESET_FAULT is refused while it is above */
    const double limit_Pa = limit_of("pressure_max_Pa");
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        uint16_t *const pressure = &sensors.pressure[n / CHAMBERS][n % CHAMBERS];
        setUp();
        to_run(CONTROLLER_PID);
        while (*pressure < below_Pa(limit_Pa)) {
            *pressure = (uint16_t)fmin(*pressure + 1900, below_Pa(limit_Pa));
            expect_none(1);
        }
        expect_none(20);
        *pressure = above_Pa(limit_Pa);
        expect_none(OUTSIDE_TICKS - 1);
        *pressure = below_Pa(limit_Pa);
        expect_none(1);
        *pressure = above_Pa(limit_Pa);
        expect_none(OUTSIDE_TICKS - 1);
        expect_fault(FAULT_OVER_PRESSURE);
        expect_reset_refused(REFUSAL_CAUSE_PERSISTS);
        *pressure = below_Pa(limit_Pa);
        tick();
        expect_reset();
    }
}

static void test_cavitation_taken_for_the_model(void)
{
    /* GIVEN RUN WHEN a chamber is just above the limit THEN nothing; below it for 49 ms nothing, for 50 CAVITATION: the
     * estimate is held, the arm goes on, and a second after the pressure is back it is over */
    const double limit_Pa = limit_of("pressure_min_Pa");
    const unsigned persist_ticks = (unsigned)lround(limit_of("persist_s") * 1e3);
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        uint16_t *const pressure = &sensors.pressure[n / CHAMBERS][n % CHAMBERS];
        setUp();
        *pressure = below_Pa(10e5); /* so that it is one step to nothing */
        to_run(CONTROLLER_PID);
        *pressure = above_Pa(limit_Pa);
        expect_none(2 * persist_ticks);
        *pressure = below_Pa(limit_Pa);
        expect_none(persist_ticks - 1);
        *pressure = above_Pa(limit_Pa);
        expect_none(1);
        *pressure = below_Pa(limit_Pa);
        expect_none(persist_ticks - 1);
        expect_fault(FAULT_CAVITATION);
        ticks(3 * SECOND_TICKS);
        TEST_ASSERT_TRUE(fault_active(&ecu, FAULT_CAVITATION)); /* as long as it lasts */
        *pressure = above_Pa(limit_Pa);
        expect_gone_after_a_second(FAULT_CAVITATION);
    }
}

static void test_degrading_fault_outlives_the_motion(void)
{
    /* GIVEN each fault that degrades WHEN the arm is stopped while it is active THEN it ends in STANDBY, not in FAULT, and
     * a second after its cause the fault is gone all the same */
    static const enum ecu_fault faults[] = {FAULT_MODEL_MISMATCH, FAULT_CAVITATION, FAULT_ESTIMATE_AT_BOUND};
    for (unsigned n = 0; n < COUNT_OF(faults); n++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        fault_raise(&ecu, &PORT, faults[n]);
        ecu.supervision.clear[CLEARING_MISMATCH] = faults[n] == FAULT_MODEL_MISMATCH ? SECOND_TICKS : 0;
        ecu.supervision.clear[CLEARING_CAVITATION] = faults[n] == FAULT_CAVITATION ? SECOND_TICKS : 0;
        ecu.supervision.clear[CLEARING_BOUND] = faults[n] == FAULT_ESTIMATE_AT_BOUND ? SECOND_TICKS : 0;
        ask(REQUEST_STANDBY);
        ticks(STOP_TICKS);
        TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
        TEST_ASSERT_EQUAL_HEX32(1u << faults[n], ecu.active_faults);
        ticks(SECOND_TICKS - STOP_TICKS);
        TEST_ASSERT_EQUAL_HEX32(1u << faults[n], ecu.active_faults);
        tick();
        TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
        TEST_ASSERT_FALSE(ecu.controller.estimator.held);
    }
}

static void test_joint_far_from_its_reference_driven_on(void)
{
    /* GIVEN RUN WHEN a joint is just less than the limit from its reference THEN nothing; just more for 2 ticks nothing,
     * for 3 TRACKING_ERROR; RESET_FAULT, RUN from where it is */
    const double limit_rad = limit_of("tracking_error_rad");
    for (unsigned n = 0; n < 2u * JOINTS; n++) {
        const enum joint i = n % 2u == 0u ? SWING : WRIST;
        const double sign = n / 2u == 0u ? 1 : -1;
        const int32_t near = angle_raw(0.1 + sign * (limit_rad - 2e-6));
        const int32_t far = angle_raw(0.1 + sign * (limit_rad + 2e-6));
        setUp();
        to_run(CONTROLLER_PID);
        push(i, sign * (limit_rad - 1e-3));
        sensors.angle[i] = near;
        expect_none(5);
        sensors.angle[i] = far;
        expect_none(OUTSIDE_TICKS - 1);
        sensors.angle[i] = near;
        expect_none(1);
        sensors.angle[i] = far;
        expect_none(OUTSIDE_TICKS - 1);
        expect_fault(FAULT_TRACKING_ERROR);
        expect_reset();
        run_again();
        expect_none(20);
    }
}

static bool fully_open(enum joint i)
{
    const double u = real(ecu.controller.output[i].u);
    return u >= 1 || u <= -1;
}

static void test_valve_fully_open_for_ever(void)
{
    /* GIVEN RUN with PID WHEN a valve is commanded fully open for 0.3 s less a tick THEN nothing, and a tick's break
     * starts the time again; for 0.3 s VALVE_SATURATED. Either joint, either way */
    const int limit_ticks = (int)lround(limit_of("saturation_s") * 1e3);
    for (unsigned n = 0; n < 2u * JOINTS; n++) {
        const enum joint i = n % 2u == 0u ? SWING : WRIST;
        const double sign = n / 2u == 0u ? 1 : -1;
        setUp();
        to_run(CONTROLLER_PID);
        push(i, sign * 0.1);
        int open = 0;
        for (int k = 0; k < 1000 && open < limit_ticks - 1; k++) {
            expect_none(1);
            open = fully_open(i) ? open + 1 : 0;
        }
        TEST_ASSERT_EQUAL_INT(limit_ticks - 1, open);
        sensors.angle[i] -= angle_raw(sign * 0.003);
        expect_none(1);
        TEST_ASSERT_FALSE(fully_open(i));
        sensors.angle[i] += angle_raw(sign * 0.003);
        for (int k = 0; k < limit_ticks - 1; k++) {
            expect_none(1);
            TEST_ASSERT_TRUE(fully_open(i));
        }
        expect_fault(FAULT_VALVE_SATURATED);
        expect_reset();
    }
}

static void test_load_at_the_end_of_its_range_believed(void)
{
    /* GIVEN RUN WHEN the load estimate is just inside its range THEN nothing; at either end for half a second less a tick
     * nothing, then ESTIMATE_AT_BOUND for a second; held meanwhile, tried again, and if it stays a fault again. While
     * commissioning, when the load is pinned, nothing */
    const unsigned limit_ticks = (unsigned)lround(limit_of("bound_s") * 1e3);
    for (int high = 0; high < 2; high++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        const struct prior *const load = &ecu.machine.estimator.m[M_T];
        scalar *const m_t = &ecu.controller.estimator.theta_m[M_T];
        const double inside = high == 1 ? real(load->high) - 1e-3 : real(load->low) + 1e-3;
        *m_t = from_real(inside);
        expect_none(2 * limit_ticks);
        *m_t = high == 1 ? load->high : load->low;
        expect_none(limit_ticks - 1);
        *m_t = from_real(inside);
        expect_none(1);
        *m_t = high == 1 ? load->high : load->low;
        expect_none(limit_ticks - 1);
        expect_fault(FAULT_ESTIMATE_AT_BOUND);
        expect_gone_after_a_second(FAULT_ESTIMATE_AT_BOUND);
        expect_none(limit_ticks - 2); /* the tick that cleared it counts */
        ticks(2);
        TEST_ASSERT_EQUAL_HEX32(1u << FAULT_ESTIMATE_AT_BOUND, ecu.active_faults);
        *m_t = from_real(inside);
        ticks(SECOND_TICKS + 2);
        expect_none(2 * limit_ticks);
    }
    struct parameter_image image = default_parameter_image;
    image_set(&image, "estimator.prior.m_t_kg.low", 0);
    power_on(&image, 1000);
    to_standby();
    ask(REQUEST_COMMISSION);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_COMMISSION, ecu.mode);
    expect_none(2 * limit_ticks);
}

static void test_late_ticks_wrongly_counted(void)
{
    /* GIVEN RUN WHEN 20 periods are missed within a second, and 20 in the next THEN nothing; with the 21st of a second
     * LATE_TICKS. What was missed before the start does not count, nor after RESET_FAULT */
    const uint32_t most = (uint32_t)limit_of("late_ticks");
    to_standby();
    ecu_note_late_start(&ecu, 10 * most);
    expect_none(5);
    run_again();
    expect_none(5);
    ecu_note_late_start(&ecu, most);
    expect_none(SECOND_TICKS);
    for (uint32_t k = 0; k < most; k++) {
        ecu_note_late_start(&ecu, 1);
        expect_none(5);
    }
    expect_none(SECOND_TICKS);
    ecu_note_late_start(&ecu, most);
    expect_none(1);
    ecu_note_late_start(&ecu, 1);
    expect_fault(FAULT_LATE_TICKS);
    expect_reset();
    run_again();
    expect_none(10);
    ecu_note_late_start(&ecu, UINT32_MAX); /* a machine that slept */
    expect_fault(FAULT_LATE_TICKS);
}

static void test_many_late_ticks_counted_as_few(void)
{
    /* GIVEN counts that together pass 65535 or 2^32 WHEN added up THEN the sum stays at its end */
    static const uint32_t missed[][2] = {{65000, 600}, {1, UINT32_MAX}, {UINT32_MAX, 1}, {30, 65535}};
    for (unsigned n = 0; n < COUNT_OF(missed); n++) {
        setUp();
        ecu_note_late_start(&ecu, missed[n][0]);
        ecu_note_late_start(&ecu, missed[n][1]);
        TEST_ASSERT_EQUAL_UINT16(65535, ecu.supervision.late_starts);
    }
}

static void test_master_of_another_dbc_obeyed(void)
{
    /* GIVEN each mode without and with motion WHEN the master tells this firmware's hash THEN nothing; another THEN
     * DBC_MISMATCH, FAULT at once; reset only with the right one, or none */
    for (int n = 0; n < 3; n++) {
        setUp();
        if (n == 1) {
            to_standby();
        } else if (n == 2) {
            to_run(CONTROLLER_DIARC);
        } else {
            /* INIT, not one sensor frame yet */
            silence(true);
            tick();
        }
        ecu.master_hash = DIARC_DBC_HASH;
        expect_none(10);
        ecu.master_hash = DIARC_DBC_HASH ^ 1u;
        expect_fault(FAULT_DBC_MISMATCH);
        silence(false);
        queue_nmt(NMT_START, 1);
        tick();
        expect_reset_refused(REFUSAL_CAUSE_PERSISTS);
        ecu.master_hash = n == 0 ? 0 : DIARC_DBC_HASH;
        expect_reset();
    }
}

static void test_second_ecu_on_the_bus_not_noticed(void)
{
    /* GIVEN INIT without sensors, STANDBY, RUN and SAFE_STOP WHEN a frame comes that only this ECU sends THEN
     * DUPLICATE_NODE, FAULT at once; reset when there has been none for 100 ticks, not before. Other nodes' frames are
     * none */
    static const uint32_t own[] = {0x80, 0x202, 0x181, 0x701};
    static const uint32_t others[] = {0x702, 0x582, 0x555, 0x7FF, 0x100};
    for (unsigned n = 0; n < 4u * COUNT_OF(own); n++) {
        setUp();
        if (n / 4u == 0u) {
            silence(true);
            tick();
        } else {
            to_standby();
        }
        if (n / 4u >= 2u) {
            run_again();
        }
        if (n / 4u == 3u) {
            ask(REQUEST_SAFE_STOP);
            ticks(10);
            TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
        }
        for (unsigned k = 0; k < COUNT_OF(others); k++) {
            queue((struct can_frame_11bit){.id = others[k], .length = 1, .data = {5}});
        }
        expect_none(1);
        queue((struct can_frame_11bit){.id = own[n % 4u], .length = 1, .data = {5}});
        expect_fault(FAULT_DUPLICATE_NODE);
        silence(false);
        queue_nmt(NMT_START, 1);
        ticks(98);
        expect_reset_refused(REFUSAL_CAUSE_PERSISTS);
        expect_reset();
    }
}

static void test_damaged_store_ignored_or_reset_without_sensors(void)
{
    /* GIVEN an ECU whose store is damaged WHEN switched on THEN FAULT; RESET_FAULT is refused before the first sensor
     * frames have come, and accepts what is loaded after */
    for (int sampled = 0; sampled < 2; sampled++) {
        setUp();
        silence(sampled == 0);
        queue_nmt(NMT_START, 1);
        ecu_tick_begin(&ecu, &PORT);
        bus.sent_count = 0;
        fault_raise(&ecu, &PORT, FAULT_STORE_DAMAGED);
        expect_emergency(FAULT_STORE_DAMAGED);
        ecu_tick_end(&ecu, &PORT);
        TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
        tick();
        if (sampled == 0) {
            expect_reset_refused(REFUSAL_SENSORS_NOT_FRESH);
            silence(false);
            tick();
        }
        expect_reset();
    }
}

static void queue_heartbeat(uint8_t node)
{
    queue((struct can_frame_11bit){.id = 0x700u + node, .length = 1, .data = {5}});
}

static void test_silent_node_not_missed(void)
{
    /* GIVEN RUN WHEN the I/O node was never heard, or is heard every 0.5 s THEN nothing; silent for longer THEN
     * HEARTBEAT_LOST to the tick, whatever other nodes say; reset once it is back, not before */
    to_run(CONTROLLER_DIARC);
    expect_none(2000);
    for (int k = 0; k < 3; k++) {
        queue_heartbeat(2);
        expect_none(500);
    }
    queue_heartbeat(2);
    expect_none(400);
    queue_heartbeat(3);
    expect_none(100);
    expect_fault(FAULT_HEARTBEAT_LOST);
    expect_reset_refused(REFUSAL_CAUSE_PERSISTS);
    queue_heartbeat(2);
    tick();
    expect_reset();
}

static void test_heartbeat_consumed_though_told_not_to(void)
{
    /* GIVEN object 1016h with no node, or no time, or the longest time at the shortest tick WHEN the node falls silent
     * THEN never a fault, or one after 65.535 s */
    static const uint32_t consumed[] = {0, 500, 2u << 16};
    for (unsigned n = 0; n < COUNT_OF(consumed); n++) {
        setUp();
        ecu.heartbeat_consumer = consumed[n];
        to_run(CONTROLLER_DIARC);
        queue_heartbeat(2);
        expect_none(1500);
    }
    power_on_with_period(250);
    ecu.heartbeat_consumer = 2u << 16 | 65535u;
    to_run(CONTROLLER_DIARC);
    queue_heartbeat(2);
    expect_none(1);
    TEST_ASSERT_EQUAL_UINT32(250, ecu.supervision.consumer_us);
    ecu.supervision.consumer_us = 65000000; /* 260000 ticks on */
    expect_none(4 * 535);
    tick();
    TEST_ASSERT_EQUAL_HEX32(1u << FAULT_HEARTBEAT_LOST, ecu.active_faults);
    ecu.supervision.consumer_us = UINT32_C(1) << 31; /* and its count ends there */
    tick();
    TEST_ASSERT_EQUAL_UINT32(UINT32_C(1) << 31, ecu.supervision.consumer_us);
}

static void test_bus_that_takes_no_valve_frame_driven_on(void)
{
    /* GIVEN RUN WHEN the bus takes no frame for 5 ticks THEN nothing; for 6 THEN SEND_FAILED: FAULT, valves off with the
     * first frame that passes again; reset then, not before. In STANDBY, where the valves are shut, nothing */
    const unsigned most = (unsigned)limit_of("send_ticks");
    to_standby();
    bus.full = true;
    ticks(300);
    TEST_ASSERT_EQUAL_UINT8(255, ecu.supervision.send_failures);
    TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
    bus.full = false;
    tick();
    run_again();
    bus.full = true;
    expect_none(most);
    bus.full = false;
    expect_none(1);
    bus.full = true;
    expect_none(most + 1);
    tick(); /* seen before the frame of this tick is sent */
    TEST_ASSERT_EQUAL_HEX32(1u << FAULT_SEND_FAILED, ecu.active_faults);
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    expect_reset_refused(REFUSAL_CAUSE_PERSISTS);
    TEST_ASSERT_FALSE(ecu.supervision.send_failures == 0u);
    bus.full = false;
    tick();
    TEST_ASSERT_EQUAL_UINT32(DISABLED, get_bits(sent(0x202)->data, 48, 4));
    TEST_ASSERT_EQUAL_UINT32(FAULT_SEND_FAILED, get_bits(timing_page(0), 56, 8));
    expect_reset();
}

static void test_several_faults_told_as_one(void)
{
    /* GIVEN CAVITATION WHEN a fault that stops follows, then one that shuts the valves THEN each has its own emergency with
     * all that are active in it, TIMING shows the first that stops, and one RESET_FAULT ends them all */
    to_run(CONTROLLER_PID);
    fault_raise(&ecu, &PORT, FAULT_CAVITATION);
    ecu.supervision.clear[CLEARING_CAVITATION] = 2 * SECOND_TICKS;
    TEST_ASSERT_EQUAL_INT(FAULT_CAVITATION, ecu.fault);
    silence(true);
    ticks(WRONG_TICKS + 1);
    TEST_ASSERT_EQUAL_INT(FAULT_SENSOR_FRAMES_LOST, ecu.fault);
    const uint8_t *d = sent(0x81)->data;
    TEST_ASSERT_EQUAL_HEX8(GENERIC | COMMUNICATION | MANUFACTURER, d[2]);
    TEST_ASSERT_EQUAL_HEX32(1u << FAULT_CAVITATION | 1u << FAULT_SENSOR_FRAMES_LOST, get_bits(d, 32, 32));
    ticks(50);
    TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
    ecu.master_hash = 1;
    tick();
    d = sent(0x81)->data;
    TEST_ASSERT_EQUAL_HEX32(0xFF0F, get_bits(d, 0, 16));
    TEST_ASSERT_EQUAL_HEX32(1u << FAULT_CAVITATION | 1u << FAULT_SENSOR_FRAMES_LOST |
                                1u << FAULT_DBC_MISMATCH,
                            get_bits(d, 32, 32));
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    TEST_ASSERT_EQUAL_INT(FAULT_SENSOR_FRAMES_LOST, ecu.fault);
    ecu.master_hash = 0;
    silence(false);
    tick();
    expect_reset();
}

static void test_fault_shown_is_over_already(void)
{
    /* GIVEN two faults that degrade WHEN the first is over THEN the other is shown, and no emergency says that all is
     * well; raised again while active, or cleared while not, nothing happens */
    to_run(CONTROLLER_PID);
    fault_raise(&ecu, &PORT, FAULT_CAVITATION);
    fault_raise(&ecu, &PORT, FAULT_MODEL_MISMATCH);
    TEST_ASSERT_EQUAL_INT(FAULT_CAVITATION, ecu.fault);
    bus.sent_count = 0;
    fault_raise(&ecu, &PORT, FAULT_CAVITATION);
    fault_raise(&ecu, &PORT, FAULT_NONE);
    fault_clear(&ecu, &PORT, FAULT_ESTIMATE_AT_BOUND);
    TEST_ASSERT_EQUAL_UINT(0, bus.sent_count);
    fault_clear(&ecu, &PORT, FAULT_CAVITATION);
    TEST_ASSERT_EQUAL_INT(FAULT_MODEL_MISMATCH, ecu.fault);
    TEST_ASSERT_TRUE(ecu.controller.estimator.held);
    TEST_ASSERT_EQUAL_UINT(0, bus.sent_count);
    fault_raise(&ecu, &PORT, FAULT_CAVITATION);
    fault_clear(&ecu, &PORT, FAULT_CAVITATION);
    TEST_ASSERT_EQUAL_INT(FAULT_MODEL_MISMATCH, ecu.fault); /* the one shown stays */
    fault_clear(&ecu, &PORT, FAULT_MODEL_MISMATCH);
    TEST_ASSERT_EQUAL_INT(FAULT_NONE, ecu.fault);
    TEST_ASSERT_FALSE(ecu.controller.estimator.held);
    TEST_ASSERT_EQUAL_HEX8(0, fault_error_register(&ecu));
}

static void test_time_limit_shorter_or_longer_than_can_be_counted(void)
{
    /* GIVEN the shortest cavitation at the longest tick WHEN a chamber's pressure is gone THEN a fault in the first tick,
     * and none before; the longest limits at the shortest tick are the longest that can be counted */
    struct parameter_image image = default_parameter_image;
    image_set(&image, "supervision.persist_s", 0.001);
    image_set(&image, "control.observer_rad_s", 20);
    power_on(&image, 20000);
    sensors.pressure[WRIST][BORE] = below_Pa(40e5);
    to_run(CONTROLLER_PID);
    expect_none(5);
    sensors.pressure[WRIST][BORE] = 0;
    expect_fault(FAULT_CAVITATION);
    /* noise may give the same pressure in two ticks; a spool has 10 ms, but never less than a tick */
    TEST_ASSERT_EQUAL_UINT16(20, ecu.supervision.stuck_ticks);
    TEST_ASSERT_EQUAL_UINT16(1, ecu.supervision.spool_ticks);
    image = default_parameter_image;
    image_set(&image, "supervision.bound_s", 30);
    image_set(&image, "supervision.saturation_s", 16.3);
    power_on(&image, 250);
    TEST_ASSERT_EQUAL_UINT16(UINT16_MAX, ecu.supervision.bound_ticks);
    TEST_ASSERT_EQUAL_UINT16(65200, ecu.supervision.saturation_ticks);
}

static void test_cause_that_lasts_for_ever_taken_for_gone(void)
{
    /* GIVEN sensors that are silent for 300 ticks, a pressure that is low for more than 65535 WHEN the counts are at
     * their ends THEN they stay there: INIT, and the fault, last as long as their cause */
    to_standby();
    silence(true);
    for (int k = 0; k < 300; k++) {
        tick();
        TEST_ASSERT_EQUAL_INT(k < WRONG_TICKS ? MODE_STANDBY : MODE_INIT, ecu.mode);
    }
    TEST_ASSERT_EQUAL_UINT8(255, ecu.supervision.sensors_wrong);
    setUp();
    sensors.pressure[SWING][BORE] = below_Pa(limit_of("pressure_min_Pa"));
    to_run(CONTROLLER_PID);
    ecu.supervision.lasting[LASTING_CAVITATION] = UINT16_MAX - 1u;
    expect_fault(FAULT_CAVITATION);
    ticks(3);
    TEST_ASSERT_EQUAL_UINT16(UINT16_MAX, ecu.supervision.lasting[LASTING_CAVITATION]);
    TEST_ASSERT_TRUE(fault_active(&ecu, FAULT_CAVITATION));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_fault_too_early_or_never);
    RUN_TEST(test_invalid_sensor_value_used);
    RUN_TEST(test_degraded_sensor_taken_for_invalid);
    RUN_TEST(test_fault_left_by_itself);
    RUN_TEST(test_end_of_a_fault_not_told);
    RUN_TEST(test_lost_angle_kicks_the_valve);
    RUN_TEST(test_late_answers_taken);
    RUN_TEST(test_fault_table_says_something_else);
    RUN_TEST(test_cause_of_wrong_sensors_not_the_last_of_them);
    RUN_TEST(test_frame_refused_by_length_crc_or_counter_taken);
    RUN_TEST(test_pressure_out_of_range_used_or_a_legal_one_refused);
    RUN_TEST(test_angle_where_no_arm_can_be_used);
    RUN_TEST(test_angle_faster_than_any_arm_used);
    RUN_TEST(test_angle_just_too_fast_used);
    RUN_TEST(test_angle_that_stopped_the_arm_moves_the_estimate);
    RUN_TEST(test_noise_that_is_refused_sneaks_in);
    RUN_TEST(test_pressure_that_jumps_used);
    RUN_TEST(test_pressure_after_lost_frames_taken_for_a_jump);
    RUN_TEST(test_single_spike_reaches_the_law);
    RUN_TEST(test_stuck_encoder_not_noticed);
    RUN_TEST(test_slow_encoder_taken_for_stuck);
    RUN_TEST(test_stuck_pressure_not_noticed_or_a_still_one_taken_for_it);
    RUN_TEST(test_contradicting_sensors_not_noticed);
    RUN_TEST(test_spool_that_lies_moves_the_estimate);
    RUN_TEST(test_encoder_that_contradicts_the_oil_believed);
    RUN_TEST(test_move_with_true_sensors_taken_for_a_contradiction);
    RUN_TEST(test_spool_elsewhere_than_it_was_sent_driven_on);
    RUN_TEST(test_loads_that_change_too_often_believed);
    RUN_TEST(test_joint_beyond_its_soft_limit_driven_on);
    RUN_TEST(test_over_pressure_driven_on);
    RUN_TEST(test_cavitation_taken_for_the_model);
    RUN_TEST(test_degrading_fault_outlives_the_motion);
    RUN_TEST(test_joint_far_from_its_reference_driven_on);
    RUN_TEST(test_valve_fully_open_for_ever);
    RUN_TEST(test_load_at_the_end_of_its_range_believed);
    RUN_TEST(test_late_ticks_wrongly_counted);
    RUN_TEST(test_many_late_ticks_counted_as_few);
    RUN_TEST(test_master_of_another_dbc_obeyed);
    RUN_TEST(test_second_ecu_on_the_bus_not_noticed);
    RUN_TEST(test_damaged_store_ignored_or_reset_without_sensors);
    RUN_TEST(test_silent_node_not_missed);
    RUN_TEST(test_heartbeat_consumed_though_told_not_to);
    RUN_TEST(test_bus_that_takes_no_valve_frame_driven_on);
    RUN_TEST(test_several_faults_told_as_one);
    RUN_TEST(test_fault_shown_is_over_already);
    RUN_TEST(test_time_limit_shorter_or_longer_than_can_be_counted);
    RUN_TEST(test_cause_that_lasts_for_ever_taken_for_gone);
    return UNITY_END();
}
