/* The whole ECU (ecu/ecu) tick by tick: each fault of can_protocol/faults.toml, when it comes, what follows, how it is
 * left. */
#include <stdlib.h>

#include "ecu_bench.h"

void setUp(void)
{
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
    return UNITY_END();
}
