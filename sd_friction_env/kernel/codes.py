"""Codes of modes, statuses and events, and the tolerances that all of the kernel shares."""

# The mode is the sign of v_rel, frozen until an event.
SLIP_BACKWARD, STICK, SLIP_FORWARD = -1, 0, 1
UNKNOWN = 2  # what the mode was before

OK, CONTACT_LOST, EVENT_LIMIT, STEP_LIMIT = 0, 1, 2, 3

NO_EVENT, RESTICK, CROSSING, GRAZING, BREAKAWAY, CONTACT_LOSS, TURNING, LANDING = range(8)
STEP_SIZE_UNDERFLOW, SWITCHING = 8, 9

STATUS_NAMES = {OK: "ok", CONTACT_LOST: "contact lost", EVENT_LIMIT: "event limit", STEP_LIMIT: "step limit"}
EVENT_NAMES = {
    RESTICK: "restick",
    CROSSING: "crossing",
    GRAZING: "grazing",
    BREAKAWAY: "breakaway",
    CONTACT_LOSS: "contact-loss",
    STEP_SIZE_UNDERFLOW: "step-limit",
    SWITCHING: "switching",
}

FORCE, BELT_SPEED = 0, 1  # what the action is

# Estimated error per unit of time, relative to max(1, |x|, |v|, STIFF |x''|); the estimate can be too low.
TOLERANCE = 1e-10
MAX_SLIP_STEP = 0.2
MIN_SLIP_STEP = 1e-16
# A motion that needs more trial steps than these is given up (STEP_LIMIT): so many at once, so many per unit of time.
SLIP_TRIALS, SLIP_TRIAL_RATE = 100000.0, 15000.0
FASTEST_DAMPING = 3.0  # a step times the rate at which friction and damping change v_rel: longer ones are doubted
STIFF = 1e-4  # where friction is so steep that v changes by |a| h, no estimate gets below 1e-14 of that change
STEP_DOUBLING = 1.0 / 1024.0  # a step this far inside the rule doubles: the error falls as h^8, four times the margin
MAX_EVENTS = 256  # in one call of advance
V_REL_ZERO = 1e-14  # relative velocities this small cannot be told from zero after one step's rounding
TIME_ZERO = 1e-13  # events are located this closely in time
SIDE_ZERO = 1e-14  # x this small is on neither side of zero
PHASE_ROUNDING = 1e-15  # of a phase, relative to itself
ROUNDING = 1e-14  # of a sum of forces, relative to the greatest of them
LAYER_REACH = 4.0  # by so many times its distance and its width may a step change v_rel next to a friction layer
LAST_STRETCH = 1e-5  # of a step: a Taylor step of this length is exact to rounding
HUGE_EXPONENT = 700.0  # a trial step across the surface may ask for more, and is refused anyway
