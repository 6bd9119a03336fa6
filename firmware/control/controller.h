/* The whole law for both joints: trajectory, observer, estimator, then DIARC or PID. One function of state,
 * measurement, machine and dt; the ECU calls it once a tick. */
#ifndef CONTROL_CONTROLLER_H
#define CONTROL_CONTROLLER_H

#include "control/diarc.h"
#include "control/estimator.h"
#include "control/limits.h"
#include "control/observer.h"
#include "control/pid.h"
#include "control/trajectory.h"

enum controller_kind {
    CONTROLLER_PID,
    CONTROLLER_DIARC_NOLOAD, /* DIARC whose law never sees the estimated load */
    CONTROLLER_DIARC,
    CONTROLLERS
};

/* One machine, per unit: everything the law knows of it. */
struct machine {
    struct arm arm;
    struct supply supply;
    struct cylinder cylinder[JOINTS];
    struct diarc_gains diarc[JOINTS];
    struct pid_gains pid[JOINTS];
    gain observer_bandwidth; /* rad/s */
    struct estimator_parameters estimator;
    struct limits limits;
};

/* What follows from the machine and dt once. */
struct controller_constants {
    scalar dt_s;
    struct cylinder_constants cylinder[JOINTS];
    struct diarc_constants diarc[JOINTS];
    struct observer_constants observer;
    struct estimator_constants estimator;
};

/* One tick's samples, taken at one instant. */
struct measurement {
    scalar q[JOINTS];           /* rad */
    scalar dq[JOINTS];          /* increment since the tick before, rad */
    scalar p[JOINTS][CHAMBERS]; /* Pa */
    scalar spool[JOINTS];       /* -1..1 */
};

struct joint_output {
    scalar u;       /* spool set-point, -1..1 */
    scalar e1;      /* q - qd, rad */
    scalar e1_rate; /* rad/s */
    struct reference reference;
    bool saturated;
};

struct controller {
    enum controller_kind kind;
    bool armed;
    struct trajectory trajectory[JOINTS];
    struct observer observer[JOINTS];
    struct estimator estimator;
    struct diarc diarc[JOINTS];
    struct pid pid[JOINTS];
    struct joint_output output[JOINTS];
};

/* Where they are kept: too many to pass them as a value. */
void controller_constants(struct controller_constants *constants, const struct machine *machine, scalar dt_s);

/* Disarmed, estimate at the priors. */
void controller_start(struct controller *controller, const struct machine *machine,
                      const struct controller_constants *constants);

/* Arm at the measured angle, bumplessly: the next step begins at rest, with the measured force wanted. */
void controller_arm(struct controller *controller, enum controller_kind kind, const scalar q[JOINTS]);

void controller_disarm(struct controller *controller);

/* The angle's samples have a gap, or the next increment is not over one tick. */
void controller_gap(struct controller *controller);

/* One tick. Disarmed, outputs are zero and only the estimator's samples are kept up to date. */
void controller_step(struct controller *controller, const struct machine *machine,
                     const struct controller_constants *constants, const struct measurement *measured);

#endif
