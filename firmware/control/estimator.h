/* The indirect half of DIARC: least squares on filtered regressions, Eq 25 and 26.
 *
 * Rows in turn. There are four, mechanics and hydraulics of each joint; each tick one of them is taken into the estimate.
 * The mechanics of a joint are balanced over the last ROW_TURNS ticks, the window, and filtered once in that time, when it
 * is the turn of its hydraulics: they change little within a few ms, and no tick is much longer than the others. The
 * hydraulics are balanced and filtered every tick.
 *
 * Mechanics. Acceleration is never formed. The momentum m = row of H(q) q' is balanced between the middles of two
 * windows of length T,
 *     [ m_(k-1/2) - m_(k-3/2) ] / T + f_(k-1) = mean R F                         exact to O(T^2)
 * with the mean rates of the windows straight from the encoder's increments, f all other terms at the instant between
 * the windows, and the mean of R F weighted as the difference of two means weighs a rate: rising over one window and
 * falling over the other. Both sides are multiplied by the same gate, 0..1, and passed through the same filter (two
 * poles): whatever the gate and the filter are, the equation still holds, so nothing of them biases the estimate.
 *
 * Gate. At low speed friction is not what the model says, and at rest it looks like load: the gate opens with
 * the reference's speed, and the estimate rests while it is shut.
 *
 * Hydraulics. theta_h = [1/be, flow offsets]: F's increment over a tick against the flow's mean,
 *     1/be (F_k - F_(k-1)) / dt = mean( -lamA R q' + QL - leakage + lamB Om2 + lamC Om3 )
 * with QL from the measured spool; no pressure is differentiated but inside the filter. Compressibility is
 * about a hundredth of the flow, as much as a valve gain may be wrong by: so a row weighs less the more flows.
 *
 * Changed load. When the mechanics' innovations are too large for their variance several times in a row, the
 * load's variance is set back to its prior, the load's alone, and the filters start anew so that they hold
 * nothing of the old load.
 *
 * Least squares runs on UD factors; then projection onto the bounds. The law gets the
 * estimate through a rate limit: sat_M(Proj(..)). Only the load walks: its variance grows while the gate is
 * open, up to its prior (covariance bound), so that it is forgotten at a known rate and nothing winds up. */
#ifndef CONTROL_ESTIMATOR_H
#define CONTROL_ESTIMATOR_H

#include "control/arm_model.h"
#include "control/hydraulics.h"
#include "control/ud_factors.h"

/* theta_h: 1/be, then the offsets Om2 (bore), Om3 (annulus) of each joint. */
enum theta_h { BETA_INVERSE, OM2_SWING, OM3_SWING, OM2_WRIST, OM3_WRIST, THETA_H };

/* One parameter's prior knowledge. */
struct prior {
    scalar value;
    scalar sd; /* standard deviation; 0 pins the parameter to its value */
    scalar low, high;
};

struct estimator_parameters {
    struct prior m[THETA_M];
    struct prior h[THETA_H];
    scalar filter_time;          /* each of the two poles, s */
    scalar gate_rate;            /* the gate opens from this reference rate on, full at twice it; rad/s */
    scalar torque_noise[JOINTS]; /* sd of a filtered row of the mechanics, N m */
    scalar flow_noise[JOINTS];   /* sd of a filtered row of the hydraulics, m^2/s */
    scalar flow_error;           /* share of the flow that the valve gain may be wrong by */
    scalar load_walk;            /* the load's sd grows by this in 1 s of open gate, kg */
    gain rate_limit;             /* of the estimate the law sees, ranges per second */
    scalar innovation_limit;     /* standard deviations from which an innovation counts as too large */
};

/* Rows, and ticks from one turn of a row to its next: its window. */
#define ROW_TURNS 4

struct estimator_constants {
    scalar filter;            /* pole step, window / (filter_time + window) */
    gain filter_rate;         /* pole step / window, 1/s */
    scalar tick_filter;       /* the pole step of what is filtered every tick, dt / (filter_time + dt) */
    gain tick_filter_rate;    /* that over dt, 1/s */
    gain per_tick;            /* 1 / dt */
    gain per_window;          /* 1 / window */
    gain per_gate_rate;       /* 1 / gate_rate, s/rad */
    variance noise_m[JOINTS]; /* of a filtered row */
    variance noise_h[JOINTS];
    scalar scale_m[THETA_M]; /* high - low */
    scalar scale_h[THETA_H];
    scalar step_m[THETA_M]; /* rate limit per tick */
    scalar step_h[THETA_H];
    variance walk;          /* what the load gains every WALK_UPDATES updates, in its scale */
    variance load_variance; /* its bound, in its scale */
};

/* What one tick measured and the reference it was measured at. */
struct estimator_sample {
    scalar dq[JOINTS];            /* encoder increment over the last tick, rad */
    scalar reference_w[JOINTS];   /* qd', rad/s */
    scalar friction_sign[JOINTS]; /* coulomb_sign of it */
    struct wrist_trig trig;       /* at the measured q2 */
    struct cylinder_state cylinder[JOINTS];
    scalar lever[JOINTS]; /* of friction: R over that at q = 0, or 1 */
    scalar force[JOINTS]; /* F */
    scalar flow[JOINTS];  /* QL from the spool, less leakage */
};

#define HYDRAULIC_COLUMNS 3 /* 1/be, Om2, Om3 */

/* Two equal poles. A difference quotient is never formed: its sum with the first pole is kept as a `step` of its own, in
 * units of window / pole step, and so stays as small as the steps it is made of. */
struct two_poles {
    scalar first, second;
};

/* The samples of the last window, by turn. */
struct window {
    scalar dq[JOINTS][ROW_TURNS];
    scalar torque[JOINTS][ROW_TURNS]; /* R F / ROW_TURNS */
    scalar flow[JOINTS][ROW_TURNS];   /* the same of the flow */
};

/* A row of the mechanics. */
struct mechanics {
    struct two_poles column[ROW_COLUMNS + 1]; /* then the known part */
    scalar step[ROW_COLUMNS + 1];
    struct two_poles open;   /* the gate through the same filter: how much of its window it was open */
    struct arm_row momentum; /* of the window before */
    scalar w[JOINTS];        /* its mean rates */
    scalar torque;           /* its R F, weighted with 1/4, 2/4 .. 1, over ROW_TURNS */
    struct wrist_trig trig;  /* this and what follows: at its end */
    scalar lever;
    scalar friction_sign;
    scalar gate;
    uint8_t strikes; /* innovations in a row that were too large */
};

/* A row of the hydraulics. */
struct hydraulics {
    struct two_poles column[HYDRAULIC_COLUMNS + 1];
    scalar step;                                  /* of the first, the force */
    scalar lamA_R, lamB, lamC, force, flow, gate; /* of the tick before */
    uint8_t
        strikes; /* innovations in a row that were too large: sensors contradict one another; stops at 255 */
};

struct estimator {
    scalar theta_m[THETA_M]; /* projected least squares */
    scalar theta_h[THETA_H];
    scalar law_m[THETA_M]; /* what the law sees: rate limited */
    scalar law_h[THETA_H];
    scalar moved_m[THETA_M];        /* by how much law_m did in the last tick, while law_m_moved */
    struct ud_factors covariance_m; /* in units of the ranges */
    struct ud_factors covariance_h;
    struct window window;
    struct mechanics mechanics[JOINTS];
    struct hydraulics hydraulics[JOINTS];
    scalar ramp;          /* 0..1, brings the gate up smoothly after a start of the filters */
    uint16_t reopened;    /* how often a changed load was noticed; stops at 65535 */
    bool held;            /* no update: what the sensors say is in doubt */
    bool commissioning;   /* there is no load and everything else is open */
    uint8_t walk_updates; /* updates since the load walked last */
    uint8_t turn;         /* which row is next, 0..3 */
    uint8_t samples;      /* since the restart, up to 2 windows and one: balances need as many */
    bool follows_m;       /* law_m is theta_m */
    bool follows_h;
    bool law_m_moved;
    bool updating; /* an update was made within the last four ticks */
    uint8_t since_update;
};

void estimator_constants(struct estimator_constants *constants, const struct estimator_parameters *parameters,
                         scalar dt_s);

/* Everything back to the priors. */
void estimator_start(struct estimator *estimator, const struct estimator_parameters *parameters,
                     const struct estimator_constants *constants);

/* Commissioning: the load is none and stays so, all other parameters are open to a quarter of their ranges. */
void estimator_commission(struct estimator *estimator);

/* After commissioning: what was found stays, held as tightly as the priors say, and the load is open again. */
void estimator_operate(struct estimator *estimator, const struct estimator_parameters *parameters,
                       const struct estimator_constants *constants);

/* Forget the samples, keep the estimate: after a gap in the measurements. */
void estimator_resume(struct estimator *estimator);

/* One tick. */
void estimator_step(struct estimator *estimator, const struct estimator_parameters *parameters,
                    const struct estimator_constants *constants, const struct arm *arm,
                    const struct estimator_sample *sample);

/* The last tick was the last of joint i's window: dq and flow of `window` and the hydraulics' force are of that. Not
 * before the samples reach back to the window before. */
bool estimator_window_ended(const struct estimator *estimator, enum joint i);

/* Sum of a window's samples. */
scalar sum_of_window(const scalar sample[ROW_TURNS]);

/* Standard deviation of parameter k, in its unit. */
scalar estimator_sd_m(const struct estimator *estimator, const struct estimator_constants *constants,
                      enum theta_m k);
scalar estimator_sd_h(const struct estimator *estimator, const struct estimator_constants *constants,
                      enum theta_h k);

#endif
