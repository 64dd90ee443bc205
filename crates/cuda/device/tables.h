/* Layout of tables, columns and rows. The build script turns it into constants of Rust. Parameters and
 * workspace of a block are in tiles of TILE robots, those of a warp: [tile][number][robot of the tile],
 * so that the threads of a warp read neighbouring numbers and a number's place is a constant. A column is one number
 * of the robots of a tile, contiguous. Drive, state and report, which the host writes and reads, are
 * rows: [robot][number]. */
#ifndef POLYPOD_TABLES_H
#define POLYPOD_TABLES_H
#include "numbers.h"

/* Integers at the beginning of the integer table: sizes, settings, then where lists begin. */
enum Integer {
    SIZE_PARAMETERS, SIZE_STATE, SIZE_DRIVE, SIZE_REPORT, SIZE_WORK, SIZE_WORK_INTEGERS,
    FLOATING, JOINTS, BLOCKS, CONTACTS, ROWS, SPINS, BODIES, SITES, TREES, STRIDE, FRICTION, HAS_SURFACES,
    HAS_SPRINGS, HAS_DELAY, AGES, PAIRS, GROUPS, COLLIDERS, DECIMATION, ITERATIONS, MEASURES, CHECK_INTERVAL,
    MAX_EXTRA_ROUNDS, SWEEPS_PER_ROUND, LIMIT_SWEEPS, PUSH_SWEEPS, HAS_GROUND, LINK_FORCES,
    NETWORKS,
    /* the height grid: whether there is one, points along x and y; of links' and of candidates' squares
     * the points along an edge, numbers along x and y, and where their heights begin */
    HAS_GRID, GRID_SIZE, GRID_SQUARES = GRID_SIZE + 2, GRID_END = GRID_SQUARES + 7,
    /* lists of integers */
    T_JOINT, T_BLOCK, T_CARRIER, T_TREE, T_PATH, T_CONTACT, T_LINK_CONTACTS, T_SITE, T_COLLIDER,
    T_LINK_COLLIDERS, T_PAIR, T_GROUP, T_FORCE, T_NETWORK,
    /* lists in the table of numbers */
    C_AXIS, C_RIM, C_BOX,
    /* columns of parameters */
    P_OFFSET, P_MASS, P_COM, P_INERTIA, P_STIFFNESS, P_DAMPING, P_EFFORT_LIMIT, P_SATURATION_EFFORT,
    P_MOTOR_VELOCITY_LIMIT, P_ARMATURE, P_JOINT_DAMPING, P_JOINT_FRICTION, P_SPRING, P_LOWER, P_UPPER,
    P_VELOCITY_LIMIT, P_CONTACT_POSITION, P_CONTACT_RADIUS, P_CONTACT_RIM, P_CONTACT_FRICTION, P_LINK_BOX,
    P_COLLIDER_CENTRE, P_COLLIDER_HALF, P_COLLIDER_RADIUS, P_SITE_POSITION, P_STATIC_FRICTION,
    P_DYNAMIC_FRICTION, P_RESTITUTION, P_TORSIONAL_FRICTION, P_ROLLING_FRICTION,
    /* columns of the state, the drive and the report */
    /* the last column of the state is a list: its length, then LISTED_SIZE numbers of each contact. What
     * networks remember comes before it: of each one [number][joint] of past errors, velocities, its own */
    S_POSITION, S_ROTATION, S_LINEAR, S_ANGULAR, S_JOINT, S_JOINT_VELOCITY, S_BOUND, S_MEMORY, S_PRESSING,
    D_TARGET, D_DELAY, D_FEEDFORWARD, D_FORCE, D_TORQUE, D_ORIGIN, D_LINK_FORCE,
    R_EFFORT, R_ACCELERATION, R_BODY_FORCE, R_NORMAL_FORCE, R_SITE_POSITION, R_SITE_VELOCITY,
    /* columns of the workspace */
    W_LINK, W_DYNAMICS, W_BIAS, W_FACTOR, W_COUPLING, W_ROOT, W_RHS, W_EFFORT, W_SLOPE, W_TARGET, W_JOINTS, W_MOVED,
    W_ROW, W_FURTHER, W_SPIN, W_SPIN_FURTHER, W_BOUND, W_BOUND_FURTHER, W_COLLIDER, W_LINK_BOX,
    W_PRESSING, W_DEMANDS, W_STATE, W_TREE, W_GROUND, W_FOUND,
    /* efforts in addition to those of gains, and 0 or NaN; features of networks: [feature][joint][thread] */
    W_DRIVEN, W_UNBOUNDED, W_FEATURES,
    /* columns of integers of the workspace */
    I_ROW, I_BOUND, I_PLACED, I_PRESSING, I_TOUCHED, I_NEXT, I_NEXT_PAIR,
    NUM_INTEGERS
};

/* Numbers at the beginning of the table of numbers: the settings. */
enum Number {
    DT, GRAVITY, LOOK_AHEAD = GRAVITY + 3, IMPLICIT_STIFFNESS, SPRING_STIFFNESS, CORRECTION, MAX_PUSH,
    BOUNCE_SPEED, GROUND_MARGIN, GROUND_REACH, PAIR_REACH, PAIR_ROUNDING, LIMIT_REACH, MAX_LIMIT_REACH,
    VELOCITY_LIMIT_SHARE, GROUND_COMPLIANCE, PAIR_COMPLIANCE, MIN_TANGENT_COMPLIANCE, PENETRATION_SLOP,
    LIMIT_SLOP, MIN_CHANGE_SQUARED, SETTLED_CHANGE, DEEP_PUSH, SETTLED_CHANGE_DEEP, LEAST_BOUND, MOST_BOUND,
    MIN_FOLLOWING_RESPONSE, TURN_BACK_SHARE, LIMIT_TOLERANCE, PUSH_TOLERANCE, PLANE_OFFSET, PLANE,
    GRID_ORIGIN = PLANE + 9, GRID_CELL = GRID_ORIGIN + 2, GRID_INVERSE_CELL, GRID_HIGHEST,
    NUM_NUMBERS
};

/* Sizes of the entries of lists. */
enum Size {
    WARP = 32,        /* threads that a card steps together */
    TILE_OF_HOST = 8,
    THREADS_OF_FEW = 4, /* threads that step a robot together on a card, where robots are few */
    FEW_ROBOTS = 8192,
    THREADS_OF_MORE = 2, /* where own kernels step more robots, up to that many */
    MORE_ROBOTS = 32768,
    LISTED_SIZE = 4,  /* contact, impulse */
    JOINT_SIZE = 6,   /* parent, slides, axis (3: any), explicit, effort table (0: none), its length */
    AXIS_SIZE = 4,    /* direction, sign */
    BLOCK_SIZE = 7,   /* joints (3), length, number of carriers, first carrier, first coupling */
    CARRIER_SIZE = 2, /* block, count */
    PART_SIZE = 4,    /* block, count, number of carriers, where their places in the path are */
    CONTACT_SIZE = 3, /* link, body, whether it is on a rim */
    RIM_SIZE = 8,     /* two unit vectors, cosine and sine */
    COLLIDER_SIZE = 3, /* link, body, whether it is a box */
    PAIR_SIZE = 8,    /* colliders (2), bodies (2), parts of the capsule, path, first impulse; of each
                       * joint on the path which of the two it carries: first 2, second 0, both 1 */
    GROUP_SIZE = 4,   /* links (2), first pair, pairs */
    LINK_FORCE_SIZE = 10,
    TOGETHER = 3,     /* joints of a network that a thread computes together */
    OUTPUTS = 8,      /* outputs of a layer that it computes together: as many of their weights are neighbours */
    /* a network: joints and their list; physics steps that it looks back; where its memory begins; its inputs,
     * each with whether it is a velocity and its age; its instructions; the feature that is its output; where
     * its scale and those of the inputs are in the table of numbers */
    NET_JOINT = 1, NET_PAST, NET_MEMORY, NET_INPUTS, NET_INPUT, NET_INSTRUCTIONS, NET_INSTRUCTION, NET_OUTPUT,
    NET_NUMBERS, NETWORK_SIZE, NET_INPUT_SIZE = 2,
    /* an instruction: what it does, first feature that it reads, first one that it writes, how many; then, as
     * it needs them, inputs of a layer, the step between features that are copied, or a place in the memory;
     * the second argument, or the place of an LSTM's cell; where its numbers are */
    INSTRUCTION_SIZE = 7,
    LINK_SIZE = 30, LINK_POSITION = 9, LINK_VELOCITY = 12, LINK_FREE = 18, LINK_AXIS = 24,
    DYNAMICS_SIZE = 22, DYNAMICS_INERTIA = 6, DYNAMICS_FORCE = 16,
    TREE_SIZE = 16,   /* inertia and force that a tree brings to the base */
    FACTOR_SIZE = 42, FACTOR_INNER = 3, FACTOR_BASE = 6,
    FACTOR_RAW = 24,  /* the base's part before it is divided by the pivots */
    /* rows: base (18), own (9); of a contact then the numbers below */
    ROW_OWN = 18, ROW_COUPLING = 27, ROW_INVERSE = 30, ROW_ACROSS = 33, ROW_STICKING = 35, ROW_DIAGONAL = 38,
    ROW_SOFTNESS, ROW_SLIDE, ROW_TARGET, ROW_IMPULSE, ROW_LAST_CHANGE = ROW_IMPULSE + 3, ROW_PUSH,
    ROW_PUSH_IMPULSE, ROW_BEYOND, ROW_FRAME, ROW_SIZE = ROW_FRAME + 9,
    ROW_INTEGERS = 6, /* contact, path; pair, or -1 on the ground; the path's parts, place and list */
    SPIN_ROLL = 33, SPIN_IMPULSE = 34, SPIN_SIZE = 37,
    BOUND_FRICTION = 30, BOUND_JOINT = 33, BOUND_JOINT_SIZE = 8, BOUND_SIZE = 57,
    BOUND_INTEGERS = 10, /* limits, active; of each joint limits, has friction; the path's parts, list */
    PLACED_SIZE = 19, PLACED_HALF = 3, PLACED_RADIUS = 6, PLACED_ROTATION = 7, PLACED_EXTENT = 16,
    LINK_BOX_SIZE = 7,
    GROUND_SIZE = 5, GROUND_UP = 1, GROUND_HIGHEST = 4, /* of a link near the ground: its height first */
    /* a contact that was found: its point, normal and gap, the axes of its frame */
    FOUND_POINT = 0, FOUND_NORMAL = 3, FOUND_GAP = 6, FOUND_FRAME = 7, FOUND_SIZE = 16
};

/* Instructions of a network. */
enum NetworkInstruction {
    NETWORK_CONSTANT, NETWORK_COPY, NETWORK_AFFINE, NETWORK_RELU, NETWORK_LEAKY_RELU, NETWORK_ELU, NETWORK_TANH,
    NETWORK_SIGMOID, NETWORK_SOFTSIGN, NETWORK_ABS, NETWORK_NEG, NETWORK_ADD, NETWORK_SUB, NETWORK_MUL, NETWORK_DIV,
    NETWORK_RECALL, NETWORK_CELL
};

/* A task, for the robots of a block: integers at the beginning of its table of integers, then where lists
 * begin. Lists of terms have entries of FORM_SIZE integers. */
enum Task {
    K_SLOTS, K_ACTIONS, K_OBSERVED, K_FEET, K_AUTORESET, K_HAS_COMMAND, K_HEADING_COMMAND, K_LONGEST, K_SCALES, K_REMEMBERS,
    K_NUM_DELAYS, K_NUM_INTERVALS, K_NUM_RESETS, K_NUM_ENDS, K_NUM_REWARDS, K_NUM_TERMS, K_NUM_CURRICULA,
    K_NUM_BODY_EVENTS, K_NUM_STAGES, K_NUM_COMMANDS,
    /* bits of the causes that are failures; tiles along x and y; rays of the height scanner, and where they are
     * in the table of numbers */
    K_FAILURES, K_TILES, K_RAYS = K_TILES + 2, K_RAY,
    /* bits of the command's ranges that are widened; rule that combines the friction of robot and ground */
    K_WIDENS, K_COMBINE,
    /* where the numbers of each kind of command are among those of all commands but the velocity */
    K_PLACE, K_PLACES_END = K_PLACE + 6,
    /* lists: slots, contact bodies that are feet, their columns, groups of contact bodies, actuator delays, terms */
    K_SLOT, K_FOOT, K_FOOT_COLUMN, K_GROUP, K_DELAY, K_INTERVAL, K_RESET, K_END, K_REWARD, K_TERM,
    K_CURRICULUM, K_BODY_EVENT, K_STAGE, K_COMMANDS,
    /* columns of an env: its actions, command, timers, sums, times of its feet, stance, mass, place of
     * its origin, numbers that observations show, heights below the rays, progress of its commands, the
     * numbers of its body that resets change (those of startup events, then the present ones), and the numbers
     * of its commands but the velocity, with the time that each of these has left */
    X_ACTION, X_PREVIOUS, X_COMMAND, X_TIMER, X_SUM, X_TOTAL, X_TIME, X_DEFAULT, X_SCALE, X_SPAWN, X_MASS,
    X_ORIGIN, X_KEPT, X_SCAN, X_WIDENING, X_TRACKING, X_STARTUP, X_BODY,
    X_NUMBERS, X_WAIT,
    NUM_TASK
};

/* Numbers at the beginning of a task's table of numbers. */
enum TaskNumber {
    F_DT, F_STEP, F_HEIGHT, F_DOWN, F_FREE_FALL = F_DOWN + 3, F_LIMIT, F_RANGE = F_LIMIT + 7,
    F_HEADING = F_RANGE + 6, F_STIFFNESS = F_HEADING + 2, F_HEADING_SHARE, F_STANDING_SHARE, F_TURNING_SHARE,
    F_SIDEWAYS_SHARE, F_RESAMPLING, F_MARGIN, F_SOFT, F_BASE_VELOCITY, F_JOINT_POSITION = F_BASE_VELOCITY + 2,
    F_JOINT_VELOCITY = F_JOINT_POSITION + 2, F_MAX_ACTION = F_JOINT_VELOCITY + 2,
    F_TILE, F_WIDEST = F_TILE + 2, F_GROUND_FRICTION = F_WIDEST + 6, NUM_TASK_NUMBERS = F_GROUND_FRICTION + 4
};

/* Sizes and places of a task's lists and of an env's columns. */
enum TaskSize {
    SLOT_SIZE = 3,   /* joint, column of the batch, where the joint's sign is */
    DELAY_SIZE = 4,  /* fewest and most physics steps, number of joints, where they are */
    STAGE_SIZE = 3,  /* control step from which it holds, low and high half, and where its numbers are */
    /* a term: what it is, where its numbers and integers begin, how many integers; of an end whether it
     * truncates, of an observation its column, numbers and memory, of a reward where its weight is, and
     * the number of its stages and where they begin, of a command where its numbers are, how many, and whether
     * it is drawn in the middle of episodes */
    FORM_SIZE = 7, FORM_NUMBERS = 1, FORM_INTEGERS = 2, FORM_COUNT = 3, FORM_MORE = 4,
    /* numbers of an observation before its own: noise, clip, scale, error that lasts an episode */
    FILTER_SIZE = 5, FILTER_ERROR = 4,
    COMMAND_SIZE = 5, COMMAND_HEADING = 3, COMMAND_LEFT = 4,
    TOTALS = 6,      /* reward, errors of velocity and yaw rate, commanded ones, speed */
    TIMES = 4,       /* of each foot: contact, air, last contact, last air */
    /* numbers of a body that resets change: mass, centre of mass and inertia of the base, friction
     * (static, dynamic, torsional, rolling), then lists of the joints in the order of BodyList */
    BODY_COM = 1, BODY_INERTIA = 4, BODY_FRICTION = 10, BODY_JOINTS = 14, BODY_LISTS = 7,
    BODY_DRAW_SIZE = 2, /* a draw for each joint: list, operation; its range is among the numbers */
    /* columns of integers of an env */
    U_STATE = 0, U_INCREMENT = 2, U_LENGTH = 4, U_LIVED, U_CAUSES, U_STEPS, U_FLAGS,
    U_LEVEL, U_COLUMN, U_CLOCK, U_PINNED = U_CLOCK + 2, NUM_WORDS,
    /* bits of its flags */
    TERMINATED = 1, TRUNCATED = 2, NEEDS_RESET = 4, INVALID = 8, LOGGED = 16, FRESH = 32, FRESH_TARGETS = 64,
    HOLDS_HEADING = 128, STANDING = 256, PINNED = 512, HAS_FINAL = 1024, BROKEN = 2048, BAD_ACTION = 4096,
    AT_SAME_STEP = 0, AT_NEXT_STEP = 1, NEVER = 2,
    /* an episode that ended: env, flags, causes, steps, level, bits of the commands' widening; then its
     * totals and the sums of its terms */
    ENDED_SIZE = 6
};

/* Terms that have a form on the device. */
enum Interval { INTERVAL_PUSH_ROBOT, INTERVAL_BASE_EXTERNAL_FORCE_TORQUE };
enum Reset {
    RESET_RESET_BASE, RESET_RESET_JOINTS, RESET_RESET_JOINTS_WITHIN_LIMITS_RANGE, RESET_BASE_EXTERNAL_FORCE_TORQUE,
    RESET_ACTION_DELAY
};
/* those of which resets read the outcome change nothing themselves */
enum Curriculum {
    CURRICULUM_TERRAIN_LEVELS, CURRICULUM_COMMAND_CURRICULUM, CURRICULUM_COMMANDS_VEL, CURRICULUM_MODIFY_REWARD_WEIGHT
};
enum BodyEvent {
    BODY_EVENT_PHYSICS_MATERIAL, BODY_EVENT_ADD_BASE_MASS, BODY_EVENT_BASE_COM, BODY_EVENT_RANDOMIZE_ACTUATOR_GAINS,
    BODY_EVENT_RANDOMIZE_JOINT_PARAMETERS, BODY_EVENT_RANDOMIZE_MOTOR_STRENGTH
};
enum BodyList {
    LIST_STIFFNESS, LIST_DAMPING, LIST_EFFORT_LIMIT, LIST_SATURATION_EFFORT, LIST_ARMATURE, LIST_JOINT_FRICTION,
    LIST_JOINT_DAMPING
};
enum CommandKind {
    KIND_NONE, KIND_HEADING, KIND_POSITION, KIND_POSE, KIND_GAIT, KIND_JUMP, KIND_FOOT_PLACEMENT
};
enum Operation { OPERATION_ADD, OPERATION_SCALE, OPERATION_ABS, OPERATION_ADD_EFFORT_SHARE };
enum Combine { COMBINE_AVERAGE, COMBINE_GEOMETRIC_MEAN, COMBINE_MIN, COMBINE_MULTIPLY, COMBINE_MAX };
enum End {
    END_TIME_OUT, END_BASE_CONTACT, END_ILLEGAL_CONTACT, END_BAD_ORIENTATION, END_ROOT_HEIGHT_BELOW_MINIMUM
};
enum Reward {
    REWARD_TRACK_LIN_VEL_XY_EXP, REWARD_TRACK_ANG_VEL_Z_EXP, REWARD_LIN_VEL_Z_L2, REWARD_ANG_VEL_XY_L2,
    REWARD_FLAT_ORIENTATION_L2, REWARD_BASE_ANGULAR_VELOCITY, REWARD_BASE_LINEAR_VELOCITY, REWARD_BASE_HEIGHT_L2,
    REWARD_BASE_MOTION, REWARD_BASE_ORIENTATION, REWARD_JOINT_ACC, REWARD_JOINT_POS, REWARD_JOINT_TORQUES,
    REWARD_IS_ALIVE, REWARD_IS_TERMINATED, REWARD_JOINT_VEL, REWARD_DOF_TORQUES_L2, REWARD_DOF_ACC_L2,
    REWARD_JOINT_VEL_L2, REWARD_JOINT_DEVIATION_L1, REWARD_JOINT_POS_LIMITS, REWARD_STAND_STILL_JOINT_DEVIATION_L1,
    REWARD_ACTION_RATE_L2, REWARD_ACTION_SMOOTHNESS, REWARD_FEET_AIR_TIME, REWARD_UNDESIRED_CONTACTS,
    REWARD_AIR_TIME, REWARD_AIR_TIME_VARIANCE, REWARD_FOOT_CLEARANCE, REWARD_FOOT_SLIP, REWARD_GAIT,
    REWARD_FEET_AIR_TIME_POSITIVE_BIPED, REWARD_FEET_SLIDE, REWARD_DESIRED_CONTACTS, REWARD_GAIT_SYMMETRY,
    REWARD_UPRIGHT, REWARD_TORSO_HEIGHT, REWARD_POSTURE, REWARD_FEET_OFF_GROUND, REWARD_TRACK_BASE_HEIGHT_EXP,
    REWARD_ORIENTATION_CONTROL, REWARD_HEADING_COMMAND_ERROR_ABS, REWARD_POSITION_COMMAND_ERROR_TANH,
    REWARD_TRACKING_CONTACTS_SHAPED_FORCE, REWARD_TRACKING_CONTACTS_SHAPED_VEL, REWARD_JUMP_HEIGHT_EXP,
    REWARD_JUMP_VELOCITY_EXP, REWARD_JUMP_CONTACTS, REWARD_RAIBERT_HEURISTIC, REWARD_FEET_CLEARANCE_CMD_LINEAR,
    REWARD_SCALED_TORQUES_L2, REWARD_SCALED_ACC_L2
};
enum Observation {
    OBSERVATION_BASE_LIN_VEL, OBSERVATION_BASE_ANG_VEL, OBSERVATION_PROJECTED_GRAVITY,
    OBSERVATION_VELOCITY_COMMANDS, OBSERVATION_HEIGHT_SCAN,
    /* a number of each foot */
    OBSERVATION_FEET_CONTACT_FORCE, OBSERVATION_FEET_AIR_TIME, OBSERVATION_CLOCK_INPUTS, OBSERVATION_FEET_HEIGHT,
    /* numbers of each joint */
    OBSERVATION_JOINT_POS_REL, OBSERVATION_JOINT_VEL_REL, OBSERVATION_LAST_ACTION,
    /* numbers that an env keeps: of each joint, or any */
    OBSERVATION_KEPT_OF_JOINTS, OBSERVATION_KEPT,
    /* of bodies that resets change */
    OBSERVATION_CONTACT_FRICTION, OBSERVATION_BASE_MASS_OFFSET, OBSERVATION_BASE_COM_OFFSET,
    /* of commands */
    OBSERVATION_HEADING_COMMANDS, OBSERVATION_POSITION_COMMANDS, OBSERVATION_POSE_COMMANDS,
    OBSERVATION_GAIT_COMMANDS, OBSERVATION_JUMP_COMMANDS, OBSERVATION_FOOT_PLACEMENT_COMMANDS
};

#ifdef __CUDACC__
#ifndef TILE
#define TILE (WARP / LANES)
#endif
#else
#define TILE TILE_OF_HOST
#endif
/* threads of a robot that a tile has room for */
#define THREADS (WARP / TILE)

/* A robot of a block: its tables and its place in the columns. LANES threads step it together. All
 * make the same choices and hold the same numbers outside of memory. Where work on trees, links,
 * contacts or blocks does not depend on each other, each thread takes its share of it. What one thread
 * writes, others read after SYNC, where all threads of a warp must come: it stands in no loop or branch
 * in which robots of a morphology differ. */
typedef struct {
    int lane;       /* the thread's number among those of the robot */
    const int *t;   /* table of integers */
    const float *c; /* table of numbers */
    const float *p; /* parameters of its own */
    const float *common; /* those of the block */
    unsigned own;   /* a bit for each column of parameters: whether robots have their own */
    float *s, *w;     /* state, workspace */
    float *row, *r;   /* rows of the state and the report */
    const float *d;   /* row of the drive */
    const float *grid; /* heights [x][y], then the squares' largest heights */
    int *wi;          /* integers of the workspace */
    /* numbers of the present physics step that every part reads: arrays apart from the pointers, so
     * that a compiler keeps both in registers */
    float *base_rotation, *bias_base, *velocity_base;
    float *g, *root;  /* base block of the factor (36), and roots of its diagonal (12) */
    float *y, *moved; /* base's part of the sparse velocity */
    float violation, compliance;
    int num_contacts, num_spins;
} Robot;

/* T and TC: a size or a setting, L and LC: an entry of the tables' lists, C: where one is. With the tables of one
 * morphology in front of the text, all sizes are constants, and absent features take no code. */
#ifdef POLYPOD_TABLES
#include "morphology.h"
#define T(k) INTEGER_##k
#define TC(k) NUMBER_##k
#define L(k) INTEGERS[k]
#define LC(k) NUMBERS[k]
#define C(k) (NUMBERS + (k))
#else
#define T(k) READ(a->t + (k))
#define TC(k) READ(a->c + (k))
#define L(k) READ(a->t + (k))
#define LC(k) READ(a->c + (k))
#define C(k) (a->c + (k))
#endif
#define IS_OWN(name) (a->own >> ((name) - P_OFFSET) & 1)
#define P(name, i) READ(IS_OWN(name) ? a->p + (T(name) + (i)) * TILE : a->common + T(name) + (i))
#define S(k) (a->s[(k) * TILE])
#define D(k) (a->d[k])
#define R(k) (a->r[k])
#define W(k) (a->w[(k) * TILE])
#define I(k) (a->wi[(k) * TILE])
#define TOUCHED(k) I(T(I_TOUCHED) + (k))
/* whether this thread does the work that is done once */
#define IS_FIRST(a) ((a)->lane == 0)
/* the share of this thread of some numbered things */
#define SHARED_OUT(i, end) ROLLED for (int i = a->lane; i < (end); i += LANES)
/* the trees of this thread; the blocks of a tree, from the base to the leaves and back */
#define TREES_OF(tree) ROLLED for (int tree = T(TREES) - 1 - a->lane; tree >= 0; tree -= LANES)
#define TREE_COUNT(tree) L(T(T_TREE) + 2 * (tree))
#define TREE_BLOCK(tree, k) L(L(T(T_TREE) + 2 * (tree) + 1) + (k))
#define OUTWARD(tree, k) ROLLED for (int k = 0; k < TREE_COUNT(tree); k++)
#define INWARD(tree, k) ROLLED for (int k = TREE_COUNT(tree) - 1; k >= 0; k--)

FN void load_parameters(const Robot *a, int is_own, int at, int n, float *o) {
    const float *from = is_own ? a->p + at * TILE : a->common + at;
    int step = is_own ? TILE : 1;
    for (int i = 0; i < n; i++) o[i] = READ(from + i * step);
}
#define p_load(a, name, at, n, o) load_parameters(a, IS_OWN(name), T(name) + (at), n, o)
FN void s_load(const Robot *a, int at, int n, float *o) {
    for (int i = 0; i < n; i++) o[i] = S(at + i);
}
FN void d_load(const Robot *a, int at, int n, float *o) {
    for (int i = 0; i < n; i++) o[i] = D(at + i);
}
FN void w_load(const Robot *a, int at, int n, float *o) {
    for (int i = 0; i < n; i++) o[i] = W(at + i);
}
FN void w_store(Robot *a, int at, int n, const float *x) {
    for (int i = 0; i < n; i++) W(at + i) = x[i];
}
#define LINK(l) (T(W_LINK) + (l) * LINK_SIZE)
#define BLOCK_AT(b) (T(T_BLOCK) + (b) * BLOCK_SIZE)
#define FACTOR(b) (T(W_FACTOR) + (b) * FACTOR_SIZE)
#define COUPLING(c) (T(W_COUPLING) + (c) * 9)
#define ROOT(b) (T(W_ROOT) + (b) * 6)
/* a path: its number of parts, and the first of them */
#define PATH_PARTS(path) (L(T(T_PATH) + 2 * (path)))
#define PATH_FIRST(path) (L(T(T_PATH) + 2 * (path) + 1))
#define PART(path, i) (PATH_FIRST(path) + (i) * PART_SIZE)
#endif
