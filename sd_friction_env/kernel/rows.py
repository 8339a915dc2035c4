"""All rows of the arrays that batches work on."""

# An environment's state, floats; the leaves of its plant (:mod:`sd_friction_env.kernel.leaves`) come last ...
(
    STATE_BELT_SPEED,
    STATE_X,
    STATE_V,
    STATE_BELT,
    STATE_TRAVEL,
    STATE_WORST,
    STATE_RETURN,
    STATE_VIBRATION,
    STATE_EFFORT,
    STATE_STICK,
    STATE_CONTACT_LOSS,
    STATE_LATE_LOW,
    STATE_LATE_HIGH,
    STATE_LATE_STICK,
    STATE_LATE_TIME,
    STATE_END_TIME,
    STATE_PLANT,
) = range(17)
# ... and whole numbers.
COUNT_STEPS, COUNT_KEY, COUNT_EPISODE, COUNT_SEEN, COUNT_OVER, COUNT_FIRST_STEP, COUNT_STATUS = range(7)
COUNT_ROWS = 7
RUNNING, TRUNCATED, ENDED = 0, 1, 2  # what COUNT_OVER says

# Numbers that hold for the whole batch: floats ...
(
    TASK_AUTHORITY,
    TASK_A_LIMIT,
    TASK_INTERVAL,
    TASK_W_EFFORT,
    TASK_W_STICK,
    TASK_CONTACT_LOSS_COST,
    TASK_LIMIT,
    TASK_X_OFFSET,
    TASK_X_SCALE,
    TASK_V_SCALE,
    TASK_BELT_AUTHORITY,
    TASK_SENSOR_NOISE,
) = range(12)
TASK_NUMBERS = 12
# ... and whole numbers.
(
    TASK_ACTUATOR,
    TASK_EPISODE_STEPS,
    TASK_LATE_STEPS,
    TASK_FULL_STATE,
    TASK_SEES_BELT,
    TASK_SENSOR_DELAY,
    TASK_ONE_PLANT,
    TASK_TRAVEL,
    TASK_SEES_PHASES,
    TASK_SHOWS,  # how many parameters are shown
) = range(10)
TASK_CODES = 10

# A block of environments is stepped in lanes: in one flat array whose rows are STRIDE apart. With such constant
# distances the compiler sees that rows do not overlap, which is what lets it use vector instructions.
LANES = 256
STRIDE = LANES + 8  # an odd number of cache lines, or rows would crowd into few places of the cache

# What a step makes of a lane: first what can be reported of it, floats ...
(
    LANE_X_END,
    LANE_V_END,
    LANE_BELT_END,
    LANE_V_REL,
    LANE_NORMAL,
    LANE_X_MIN,
    LANE_X_MAX,
    LANE_TIME,
    LANE_MEAN_V2,
    LANE_STICK_FRACTION,
    LANE_FRICTION_POWER,
    LANE_CONTROL_POWER,
    LANE_VIBRATION,
    LANE_EFFORT,
    LANE_STICK,
    LANE_CONTACT_LOSS,
    # ... and codes, then what is not ...
    LANE_MODE,
    LANE_EVENTS,
    LANE_STATUS,
    LANE_REWARD,
    LANE_TRAVEL,
    LANE_INT_V2,
    LANE_STICK_TIME,
    LANE_INT_FV,
    LANE_T_END,  # time reached, written where the status is not OK
    LANE_DONE,  # 1 where a pass gave the answer
    LANE_A,  # acceleration at the start of the slip step
    LANE_A_END,  # at its end
    LANE_ERROR,  # its error estimate
    LANE_TERMINATED,  # of an environment on its own
    LANE_TRUNCATED,
) = range(31)
# ... and what goes in (action, force and belt acceleration can be reported, too); the plant's leaves come last.
(
    LANE_ACTION,
    LANE_U,
    LANE_A_BELT,
    LANE_X,
    LANE_V,
    LANE_BELT,
    LANE_BELT_SPEED,
    LANE_PLANT,
) = range(31, 39)

# Rows of a second work space, where lanes that need another pass are gathered, in the place of what a step makes.
(
    LOOK_TIME,  # of the look, or what is left of the interval
    LOOK_SIDE,
    LOOK_LEVEL,
    LOOK_RATE,
    LOOK_MODE,
    LOOK_LANE,
    LOOK_LANDS,
    LOOK_A,
    LOOK_GAP,
    LOOK_SLOPE,
    LOOK_CURVATURE,
    LOOK_X,
    LOOK_V,
    LOOK_ACCELERATION,
    LOOK_CONTACT,
    LOOK_INT_V2,
    LOOK_INT_FV,
    ONWARD_OUTCOME,
    ONWARD_TIME,
    ONWARD_X_EVENT,
    ONWARD_V2_THERE,
    ONWARD_FV_THERE,
    ONWARD_X_END,
    ONWARD_V_END,
    ONWARD_INT_V2,
    ONWARD_STICK_TIME,
    ONWARD_INT_FV,
    ONWARD_X_MIN,
    ONWARD_X_MAX,
    ONWARD_NORMAL,
    ONWARD_EVENTS,
) = range(31)
OPEN, FINISHED, LANDED = 0.0, 1.0, 2.0  # what ONWARD_OUTCOME says
