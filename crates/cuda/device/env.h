/* A control step of an env around its physics, in the order of systems/ of polypod: one thread per env, the
 * same random numbers, the same order of operations. */
#ifndef POLYPOD_ENV_H
#define POLYPOD_ENV_H
#include "step.h"

typedef unsigned long long Wide;

/* An env: its robot, its tables and its columns. */
typedef struct {
    Robot *a;
    const int *k;
    const float *f;
    float *x;
    unsigned *u;
    size_t envs; /* numbers between two columns */
    float *drive;
    const float *action;
    float *observation, *final;
    float *kept; /* rows of drive, state and report before the physics and after it; null unless watched */
    int row;     /* numbers of the state's row */
    Wide random, increment;
    unsigned flags;
    /* what sensors read */
    float linear[3], angular[3], gravity[3];
    float ground; /* below the base, see base_height */
    float total; /* reward of the step */
} Env;

#define K(n) READ(v->k + (n))
#define F(n) READ(v->f + (n))
#define X(n) (v->x[(size_t)(n) * v->envs])
#define U(n) (v->u[(size_t)(n) * v->envs])
/* numbers of the rows of state, drive and report */
#define STATE(name, i) (a->row[T(name) + (i)])
#define DRIVE(name, i) (v->drive[T(name) + (i)])
#define REPORT(name, i) (a->r[T(name) + (i)])
#define HAS(bit) ((v->flags & (bit)) != 0)
/* half the side of the square above whose highest ground a robot begins, and the distance below which it
 * is placed, m */
#define FOOTPRINT 0.5f
#define PLACE_TOLERANCE 1e-4f
/* rays whose heights are on their way together */
#define RAYS_TOGETHER 8
#define TIME(which, foot) X(K(X_TIME) + (which) * K(K_FEET) + (foot))

/* rand_pcg's Pcg32 */
FN unsigned next_random(Env *v) {
    Wide s = v->random;
    v->random = s * 6364136223846793005ull + v->increment;
    unsigned turn = (unsigned)(s >> 59), x = (unsigned)(((s >> 18) ^ s) >> 27);
    return x >> turn | x << ((32u - turn) & 31u);
}
FN float unit(Env *v) { return (float)(next_random(v) >> 8) * (1.0f / 16777216.0f); }
FN float between(Env *v, float low, float high) { return fma_(high - low, unit(v), low); }
/* between two neighbouring numbers of the task's table */
FN float uniform(Env *v, int at) { return between(v, F(at), F(at + 1)); }
FN float steps_between(Env *v, unsigned low, unsigned high) {
    Wide span = (Wide)(high - low) + 1;
    return (float)(low + (unsigned)((next_random(v) * span) >> 32));
}

/* control steps since the simulation began */
FN Wide clock_of(const Env *v) { return (Wide)U(U_CLOCK + 1) << 32 | U(U_CLOCK); }
FN void count_step(Env *v) {
    Wide steps = clock_of(v) + 1;
    U(U_CLOCK) = (unsigned)steps;
    U(U_CLOCK + 1) = (unsigned)(steps >> 32);
}
/* where the numbers of the last of some stages are that has begun; `otherwise` before the first */
FN int stage_of(const Env *v, int stages, int count, int otherwise) {
    Wide now = clock_of(v);
    ROLLED for (int i = 0; i < count; i++) {
        int stage = stages + i * STAGE_SIZE;
        if (((Wide)(unsigned)K(stage + 1) << 32 | (unsigned)K(stage)) <= now) otherwise = K(stage + 2);
    }
    return otherwise;
}

FN int is_finite(float x) { return fabsf(x) <= 3.40282347e38f; }
FN float limited(float x, float low, float high) {
    if (x < low) x = low;
    if (x > high) x = high;
    return x;
}
FN float larger(float x, float other) { return x > other || other != other ? x : other; }
FN float smaller(float x, float other) { return x < other || other != other ? x : other; }
FN float squares(const float *x, int n) {
    float sum = 0.0f;
    for (int i = 0; i < n; i++) sum = fma_(x[i], x[i], sum);
    return sum;
}
FN float norm(const float *x, int n) { return sqrtf(squares(x, n)); }
FN float length(float x, float y) { return sqrtf(x * x + y * y); }

/* act.rs */
FN void act(Env *v) {
    const Robot *a = v->a;
    int slots = K(K_SLOTS), joints = T(JOINTS), ages = T(AGES);
    ROLLED for (int j = 0; j < joints; j++) {
        float oldest = DRIVE(D_TARGET, (ages - 1) * joints + j);
        ROLLED for (int age = ages - 1; age > 0; age--)
            DRIVE(D_TARGET, age * joints + j) = DRIVE(D_TARGET, (age - 1) * joints + j);
        DRIVE(D_TARGET, j) = oldest;
    }
    ROLLED for (int i = 0; i < slots; i++) {
        int slot = K(K_SLOT) + i * SLOT_SIZE, joint = K(slot);
        float action = v->action[K(slot + 1)];
        X(K(X_PREVIOUS) + i) = X(K(X_ACTION) + i);
        X(K(X_ACTION) + i) = action;
        DRIVE(D_TARGET, joint) = fma_(X(K(X_SCALE)), F(K(slot + 2)) * action, X(K(X_DEFAULT) + joint));
    }
    if (HAS(FRESH_TARGETS)) {
        ROLLED for (int i = joints; i < ages * joints; i++) DRIVE(D_TARGET, i) = DRIVE(D_TARGET, i % joints);
        v->flags &= ~(unsigned)FRESH_TARGETS;
    }
}

/* command/velocity.rs */
FN float heading(const float *q) {
    return atan2_(2.0f * (q[1] * q[2] + q[0] * q[3]), 1.0f - 2.0f * (q[2] * q[2] + q[3] * q[3]));
}
/* terms/schedules.rs: the present range of forward or left velocity or yaw rate */
FN void command_range(const Env *v, int d, float *o) {
    int at = stage_of(v, K(K_STAGE), K(K_NUM_STAGES), F_RANGE) + 2 * d, widest = F_WIDEST + 2 * d;
    o[0] = F(at);
    o[1] = F(at + 1);
    if (!(K(K_WIDENS) >> d & 1)) return;
    float widening = X(K(X_WIDENING));
    o[0] = smaller(larger(o[0] - widening, F(widest)), o[0]);
    o[1] = larger(smaller(o[1] + widening, F(widest + 1)), o[1]);
}
FN void draw_command(Env *v) {
    int command = K(X_COMMAND);
    for (int d = 0; d < 3; d++) {
        float range[2];
        command_range(v, d, range);
        X(command + d) = between(v, range[0], range[1]);
    }
    X(command + COMMAND_HEADING) = uniform(v, F_HEADING);
    v->flags &= ~(unsigned)(HOLDS_HEADING | STANDING);
    if (unit(v) < F(F_HEADING_SHARE) && K(K_HEADING_COMMAND)) v->flags |= HOLDS_HEADING;
    if (unit(v) < F(F_STANDING_SHARE)) v->flags |= STANDING;
    float turning = F(F_TURNING_SHARE), sideways = F(F_SIDEWAYS_SHARE);
    if (turning + sideways > 0.0f) {
        float drawn = unit(v);
        if (drawn < turning) {
            X(command) = X(command + 1) = 0.0f;
            v->flags &= ~(unsigned)HOLDS_HEADING;
        } else if (drawn < turning + sideways) {
            X(command) = X(command + 2) = 0.0f;
            v->flags &= ~(unsigned)HOLDS_HEADING;
        }
    }
    X(command + COMMAND_LEFT) = F(F_RESAMPLING);
}
FN float wrap_to_pi(float angle) {
    const float turn = (float)6.28318530717958647692;
    return angle - turn * rintf(angle / turn);
}
FN void steer(Env *v, const float *rotation) {
    int command = K(X_COMMAND);
    if (HAS(HOLDS_HEADING)) {
        float error = wrap_to_pi(X(command + COMMAND_HEADING) - heading(rotation));
        float range[2];
        command_range(v, 2, range);
        X(command + 2) = limited(F(F_STIFFNESS) * error, range[0], range[1]);
    }
    if (HAS(STANDING))
        for (int d = 0; d < 3; d++) X(command + d) = 0.0f;
}
FN void update_command(Env *v) {
    const Robot *a = v->a;
    if (!K(K_HAS_COMMAND) || HAS(PINNED)) return;
    int left = K(X_COMMAND) + COMMAND_LEFT;
    X(left) = X(left) - F(F_STEP);
    /* half a step of tolerance: the sum of steps is not exact */
    if (X(left) <= -0.5f * F(F_STEP)) draw_command(v);
    steer(v, &STATE(S_ROTATION, 0));
}

/* the other commands: number `i` of a kind of command */
#define COMMANDED(kind, i) X(K(X_NUMBERS) + K(K_PLACE + (kind)) + (i))
FN void draw_numbers(Env *v, int form) {
    const Robot *a = v->a;
    int at = K(form + FORM_NUMBERS) + 1, to = K(X_NUMBERS) + K(form + FORM_MORE), count = K(form + FORM_MORE + 1);
    switch (K(form)) {
    case KIND_POSITION:
        for (int d = 0; d < 3; d++) X(to + d) = uniform(v, at + 2 * d);
        if (K(K(form + FORM_INTEGERS)))
            X(to + 2) = atan2_(X(to + 1) - STATE(S_POSITION, 1), X(to) - STATE(S_POSITION, 0));
        return;
    case KIND_GAIT:
        /* the clock runs on from draw to draw */
        for (int i = 1; i < count; i++) X(to + i) = uniform(v, at + 2 * (i - 1));
        return;
    default: ROLLED for (int i = 0; i < count; i++) X(to + i) = uniform(v, at + 2 * i);
    }
    if (K(form) == KIND_JUMP) X(to) = -X(to);
}
FN void advance_numbers(Env *v, int form) {
    int at = K(X_NUMBERS) + K(form + FORM_MORE);
    if (K(form) == KIND_JUMP) X(at) = X(at) + F(F_STEP);
    if (K(form) == KIND_GAIT) {
        float clock = fma_(X(at + 1), F(F_STEP), X(at));
        X(at) = clock - floor_(clock);
    }
}
FN void update_numbers(Env *v) {
    ROLLED for (int i = 0; i < K(K_NUM_COMMANDS); i++) {
        int form = K(K_COMMANDS) + i * FORM_SIZE, wait = K(X_WAIT) + i;
        advance_numbers(v, form);
        if (U(U_PINNED) >> i & 1 || !K(form + FORM_MORE + 2)) continue;
        X(wait) = X(wait) - F(F_STEP);
        if (!(X(wait) <= -0.5f * F(F_STEP))) continue;
        draw_numbers(v, form);
        X(wait) = F(K(form + FORM_NUMBERS));
    }
}

/* disturb.rs */
FN void draw_wrench(Env *v, int at) {
    const Robot *a = v->a;
    for (int d = 0; d < 3; d++) DRIVE(D_FORCE, d) = uniform(v, at);
    for (int d = 0; d < 3; d++) DRIVE(D_TORQUE, d) = uniform(v, at + 2);
}
FN void disturb(Env *v) {
    const Robot *a = v->a;
    ROLLED for (int i = 0; i < K(K_NUM_INTERVALS); i++) {
        int form = K(K_INTERVAL) + i * FORM_SIZE, at = K(form + FORM_NUMBERS), timer = K(X_TIMER) + i;
        X(timer) = X(timer) - F(F_STEP);
        if (!(X(timer) <= 0.0f)) continue;
        X(timer) = uniform(v, at);
        if (K(form) == INTERVAL_PUSH_ROBOT)
            for (int d = 0; d < 2; d++) STATE(S_LINEAR, d) = STATE(S_LINEAR, d) + uniform(v, at + 2);
        else
            draw_wrench(v, at + 2);
    }
}

/* sense/imu.rs */
FN void read_imu(Env *v) {
    const Robot *a = v->a;
    float r[9], com[3], t[3];
    quat_to_mat(&STATE(S_ROTATION, 0), r);
    copy(v->angular, &STATE(S_ANGULAR, 0), 3);
    /* a reset in this kernel may have changed it, which READ would not see */
    if (K(K_NUM_BODY_EVENTS))
        for (int d = 0; d < 3; d++) com[d] = X(K(X_BODY) + BODY_COM + d);
    else
        p_load(a, P_COM, 0, 3, com);
    mul_vec_transposed(r, &STATE(S_LINEAR, 0), v->linear);
    cross(v->angular, com, t);
    add(v->linear, t, v->linear);
    float x = F(F_DOWN), y = F(F_DOWN + 1), z = F(F_DOWN + 2);
    for (int k = 0; k < 3; k++) {
        float down = r[6 + k] * z;
        /* sums with zeros would change the signs of zeros */
        if (x != 0.0f || y != 0.0f) down = fma_(r[k], x, fma_(r[3 + k], y, down));
        v->gravity[k] = down;
    }
}
/* the ground below a place about the env's origin */
FN float height_below(const Env *v, float x, float y) {
    const Robot *a = v->a;
    Sample found;
    if (!T(HAS_GRID)) return F(F_HEIGHT);
    terrain_sample(a, x, y, &found);
    return found.height;
}
/* sense/height_scan.rs, and the mean of the heights */
FN void scan_ground(Env *v) {
    const Robot *a = v->a;
    int rays = K(K_RAYS);
    const float *q = &STATE(S_ROTATION, 0);
    float x = STATE(S_POSITION, 0), y = STATE(S_POSITION, 1), sum = -0.0f;
    if (!rays) {
        v->ground = height_below(v, x, y);
        return;
    }
    float c = 1.0f - 2.0f * (q[2] * q[2] + q[3] * q[3]), s = 2.0f * (q[1] * q[2] + q[0] * q[3]);
    float size = sqrtf(c * c + s * s);
    int has_heading = size > 1e-6f;
    c = has_heading ? c / size : 1.0f;
    s = has_heading ? s / size : 0.0f;
    ROLLED for (int ray = 0; ray < rays; ray += RAYS_TOGETHER) {
        float heights[RAYS_TOGETHER];
        UNROLLED for (int k = 0; k < RAYS_TOGETHER; k++) {
            int at = K(K_RAY) + 2 * (ray + k < rays ? ray + k : rays - 1);
            float along = F(at), across = F(at + 1);
            heights[k] = height_below(v, x + (c * along - s * across), y + (s * along + c * across));
        }
        UNROLLED for (int k = 0; k < RAYS_TOGETHER; k++) {
            if (ray + k >= rays) break;
            X(K(X_SCAN) + ray + k) = heights[k];
            sum += heights[k];
        }
    }
    v->ground = sum / (float)rays;
}
/* sense/contact.rs */
FN float peak_force(const Env *v, int body) {
    const Robot *a = v->a;
    int steps = T(DECIMATION);
    float peak = 0.0f;
    ROLLED for (int step = steps > 3 ? steps - 3 : 0; step < steps; step++) {
        float force = REPORT(R_NORMAL_FORCE, step * T(BODIES) + body);
        peak = force > peak ? force : peak;
    }
    return peak;
}
FN void count_times(Env *v) {
    const Robot *a = v->a;
    float dt = F(F_DT);
    ROLLED for (int foot = 0; foot < K(K_FEET); foot++) {
        int body = K(K_FOOT) + foot;
        float contact = TIME(0, foot), air = TIME(1, foot), last_contact = TIME(2, foot), last_air = TIME(3, foot);
        body = K(body);
        ROLLED for (int step = 0; step < T(DECIMATION); step++) {
            int stands = REPORT(R_NORMAL_FORCE, step * T(BODIES) + body) > 1.0f;
            float longer_contact = contact + dt, longer_air = air + dt;
            last_air = stands && air > 0.0f ? longer_air : last_air;
            last_contact = !stands && contact > 0.0f ? longer_contact : last_contact;
            contact = stands ? longer_contact : 0.0f;
            air = stands ? 0.0f : longer_air;
        }
        TIME(0, foot) = contact;
        TIME(1, foot) = air;
        TIME(2, foot) = last_contact;
        TIME(3, foot) = last_air;
    }
}
FN float default_height(const Env *v) { return X(K(X_SPAWN)) - F(F_MARGIN); }
FN float standing_height(const Env *v, float above_base) {
    float height = default_height(v), hips = height + above_base;
    return height >= 0.5f * hips ? height : hips;
}

/* terminate.rs */
FN int within(const float *x, int n, float limit) {
    int all = 1;
    ROLLED for (int i = 0; i < n; i++) all &= fabsf(x[i]) <= limit;
    return all;
}
FN int is_allowed(const Env *v) {
    const Robot *a = v->a;
    int joints = T(JOINTS);
    return within(&STATE(S_POSITION, 0), 3, F(F_LIMIT)) & within(&STATE(S_ROTATION, 0), 4, F(F_LIMIT + 1)) &
           within(&STATE(S_LINEAR, 0), 3, F(F_LIMIT + 2)) & within(&STATE(S_ANGULAR, 0), 3, F(F_LIMIT + 3)) &
           within(&STATE(S_JOINT, 0), joints, F(F_LIMIT + 4)) &
           within(&STATE(S_JOINT_VELOCITY, 0), joints, F(F_LIMIT + 5)) &
           within(&REPORT(R_EFFORT, 0), joints, F(F_LIMIT + 6));
}
FN int is_of_groups(const Env *v, int form, int body) {
    int group = K(K_GROUP + 0);
    group = K(group + body);
    ROLLED for (int i = 0; i < K(form + FORM_COUNT); i++)
        if (K(K(form + FORM_INTEGERS) + i) == group) return 1;
    return 0;
}
/* contact bodies of the form's groups whose force is above its first number */
FN int count_contacts(const Env *v, int form) {
    const Robot *a = v->a;
    int count = 0;
    ROLLED for (int body = 0; body < T(BODIES); body++)
        count += is_of_groups(v, form, body) && peak_force(v, body) > F(K(form + FORM_NUMBERS));
    return count;
}
FN float base_height(const Env *v) {
    const Robot *a = v->a;
    return STATE(S_POSITION, 2) - v->ground;
}
/* sense/feet.rs */
FN float foot_height(const Env *v, int foot) {
    const Robot *a = v->a;
    const float *at = &REPORT(R_SITE_POSITION, 3 * foot);
    return at[2] - height_below(v, at[0], at[1]);
}
FN int ends(const Env *v, int form) {
    int at = K(form + FORM_NUMBERS);
    const float *g = v->gravity;
    float least;
    switch (K(form)) {
    case END_TIME_OUT: return U(U_LENGTH) >= (unsigned)K(K_LONGEST);
    case END_BASE_CONTACT:
    case END_ILLEGAL_CONTACT: return count_contacts(v, form) > 0;
    case END_BAD_ORIENTATION: return -g[2] < F(at) && (g[0] != 0.0f || g[1] != 0.0f || g[2] != 0.0f);
    default: {
        float height = default_height(v), share = F(at + 2), hips = height + F(at + 3);
        least = height >= 0.5f * hips ? share * height : height - (1.0f - share) * hips;
        if (F(at) > 0.0f) least = F(at + 1);
        return base_height(v) < least;
    }
    }
}
FN void terminate(Env *v) {
    v->flags &= ~(unsigned)FRESH;
    if (K(K_AUTORESET) == AT_NEXT_STEP && HAS(NEEDS_RESET)) {
        v->flags &= ~(unsigned)(TERMINATED | TRUNCATED);
        return;
    }
    U(U_LENGTH) = U(U_LENGTH) + 1;
    U(U_LIVED) = U(U_LIVED) + 1;
    unsigned causes = !is_allowed(v);
    v->flags &= ~(unsigned)(TERMINATED | TRUNCATED | INVALID | NEEDS_RESET);
    if (causes) v->flags |= INVALID | TERMINATED;
    ROLLED for (int i = 0; i < K(K_NUM_ENDS); i++) {
        int form = K(K_END) + i * FORM_SIZE;
        if (!ends(v, form)) continue;
        causes |= 1u << (i + 1);
        v->flags |= K(form + FORM_MORE) ? TRUNCATED : TERMINATED;
    }
    U(U_CAUSES) = causes;
    /* an episode that fails in its last step has failed */
    if (HAS(TERMINATED)) v->flags &= ~(unsigned)TRUNCATED;
    if (HAS(TERMINATED | TRUNCATED)) v->flags |= NEEDS_RESET;
}

/* reward/ */
FN void velocity_error(const Env *v, float *o) {
    for (int d = 0; d < 2; d++) o[d] = X(K(X_COMMAND) + d) - v->linear[d];
}
FN float command_norm(const Env *v, int n) {
    float sum = 0.0f;
    for (int d = 0; d < n; d++) sum = fma_(X(K(X_COMMAND) + d), X(K(X_COMMAND) + d), sum);
    return sqrtf(sum);
}
FN int is_moving(const Env *v, float threshold) {
    return command_norm(v, 3) > 0.0f || norm(v->linear, 2) > threshold;
}
FN int is_told_to_stand(const Env *v, float turning) {
    return command_norm(v, 2) <= 0.1f && !(turning > 0.0f && fabsf(X(K(X_COMMAND) + 2)) > 0.1f);
}
/* a contact time within the control step, give or take rounding */
FN int has_landed(const Env *v, int foot) {
    return TIME(0, foot) > 0.0f && TIME(0, foot) < F(F_STEP) + 1e-5f;
}
FN int stands_with(const Env *v, int foot, float threshold) {
    int body = K(K_FOOT) + foot;
    return peak_force(v, K(body)) > threshold;
}
FN float action_change(const Env *v) {
    float sum = 0.0f;
    ROLLED for (int i = 0; i < K(K_SLOTS); i++) {
        float change = X(K(X_ACTION) + i) - X(K(X_PREVIOUS) + i);
        sum = fma_(change, change, sum);
    }
    return sum;
}
/* the joint at a place of the form's list; a list that is -1 names all, in order */
FN int count_joints(const Env *v, int form) {
    const Robot *a = v->a;
    return K(form + FORM_COUNT) < 0 ? T(JOINTS) : K(form + FORM_COUNT);
}
FN int joint_of(const Env *v, int form, int i) {
    return K(form + FORM_COUNT) < 0 ? i : K(K(form + FORM_INTEGERS) + i);
}
/* sum of the squares of the form's joints, times its first number */
FN float joint_squares(const Env *v, int form, const float *x) {
    float sum = 0.0f;
    ROLLED for (int i = 0; i < count_joints(v, form); i++) {
        float y = x[joint_of(v, form, i)];
        sum = fma_(y, y, sum);
    }
    return F(K(form + FORM_NUMBERS)) * sum;
}
FN float joint_deviation(const Env *v, int form, float factor) {
    const Robot *a = v->a;
    float sum = -0.0f;
    ROLLED for (int i = 0; i < count_joints(v, form); i++) {
        int j = joint_of(v, form, i);
        sum += fabsf(STATE(S_JOINT, j) - X(K(X_DEFAULT) + j));
    }
    return factor * sum;
}
FN float joint_limits(const Env *v, int form) {
    const Robot *a = v->a;
    float sum = -0.0f;
    ROLLED for (int i = 0; i < count_joints(v, form); i++) {
        int j = joint_of(v, form, i);
        float q = STATE(S_JOINT, j), lower = P(P_LOWER, j), upper = P(P_UPPER, j), range = upper - lower;
        float margin = is_finite(range) ? 0.5f * (1.0f - F(F_SOFT)) * range : 0.0f;
        sum += larger(larger(lower + margin - q, q - upper + margin), 0.0f);
    }
    return F(K(form + FORM_NUMBERS)) * sum;
}
FN float foot_speed(const Env *v, int foot) {
    const Robot *a = v->a;
    return norm(&REPORT(R_SITE_VELOCITY, 3 * foot), 2);
}
FN float speed_of_standing(const Env *v, float threshold) {
    float sum = -0.0f;
    ROLLED for (int foot = 0; foot < K(K_FEET); foot++)
        if (stands_with(v, foot, threshold)) sum += foot_speed(v, foot);
    return sum;
}
FN float feet_air_time(const Env *v, float threshold, float turning) {
    float sum = -0.0f;
    if (is_told_to_stand(v, turning)) return 0.0f;
    ROLLED for (int foot = 0; foot < K(K_FEET); foot++)
        if (has_landed(v, foot)) sum += TIME(3, foot) - threshold;
    return sum;
}
FN float air_time(const Env *v, float mode, float threshold) {
    int moving = is_moving(v, threshold);
    float sum = -0.0f;
    ROLLED for (int foot = 0; foot < K(K_FEET); foot++) {
        float air = TIME(1, foot), contact = TIME(0, foot), phase = larger(air, contact);
        sum += moving ? (phase < mode ? phase : 0.0f) : limited(contact - air, -mode, mode);
    }
    return sum;
}
FN float variance_of_times(const Env *v, int which, float most) {
    int feet = K(K_FEET);
    float sum = -0.0f, of_squares = -0.0f, n = (float)feet;
    ROLLED for (int foot = 0; foot < feet; foot++) sum += smaller(TIME(which, foot), most);
    float mean = sum / n;
    ROLLED for (int foot = 0; foot < feet; foot++) {
        float d = smaller(TIME(which, foot), most) - mean;
        of_squares += d * d;
    }
    return of_squares / larger(n - 1.0f, 1.0f);
}
FN float foot_clearance(const Env *v, int at) {
    float error = -0.0f;
    ROLLED for (int foot = 0; foot < K(K_FEET); foot++) {
        float height = foot_height(v, foot) - F(at + 2);
        error += height * height * tanh_positive(F(at + 1) * foot_speed(v, foot));
    }
    return exp_(-error / F(at));
}
FN float within_square(float d, float most) { return smaller(d * d, most); }
FN float sync_error(const Env *v, int i, int j, float most) {
    return within_square(TIME(1, i) - TIME(1, j), most) + within_square(TIME(0, i) - TIME(0, j), most);
}
FN float async_error(const Env *v, int i, int j, float most) {
    return within_square(TIME(1, i) - TIME(0, j), most) + within_square(TIME(0, i) - TIME(1, j), most);
}
FN float gait(const Env *v, int at) {
    if (K(K_FEET) != 4 || !is_moving(v, F(at + 2))) return 0.0f;
    float most = F(at + 1) * F(at + 1);
    float error = sync_error(v, 0, 3, most) + sync_error(v, 2, 1, most) + async_error(v, 0, 2, most) +
                  async_error(v, 0, 1, most) + async_error(v, 3, 2, most) + async_error(v, 3, 1, most);
    return exp_(-error / F(at));
}
FN float single_stance(const Env *v, float threshold, float turning) {
    int standing = 0;
    float least = threshold;
    ROLLED for (int foot = 0; foot < K(K_FEET); foot++) standing += TIME(0, foot) > 0.0f;
    if (standing != 1 || is_told_to_stand(v, turning)) return 0.0f;
    ROLLED for (int foot = 0; foot < K(K_FEET); foot++)
        least = smaller(least, TIME(0, foot) > 0.0f ? TIME(0, foot) : TIME(1, foot));
    return least;
}
FN float gait_symmetry(const Env *v) {
    if (command_norm(v, 3) <= 0.1f) return 0.0f;
    int pairs = K(K_FEET) / 2;
    float uneven = -0.0f;
    ROLLED for (int left = 0; left < pairs; left++) {
        int right = left + pairs;
        if (!has_landed(v, left) && !has_landed(v, right)) continue;
        float x = TIME(3, left), y = TIME(3, right);
        if (x > 0.0f && y > 0.0f) uneven += fabsf(x - y);
    }
    float turn = X(K(X_COMMAND) + 2) / 0.25f;
    return uneven * exp_(-0.5f * turn * turn);
}
FN float mean_square(const float *x, int n) { return squares(x, n) / (float)(n > 1 ? n : 1); }
FN float joint_distance(const Env *v) {
    const Robot *a = v->a;
    float sum = 0.0f;
    ROLLED for (int j = 0; j < T(JOINTS); j++) {
        float d = STATE(S_JOINT, j) - X(K(X_DEFAULT) + j);
        sum = fma_(d, d, sum);
    }
    return sqrtf(sum);
}
FN float upright(const Env *v, int at) {
    float distance[3];
    for (int k = 0; k < 3; k++) distance[k] = F(at + 1 + k) + v->gravity[k];
    return exp_(-squares(distance, 3) * F(at));
}
FN float posture(const Env *v, float std) {
    const Robot *a = v->a;
    float sum = 0.0f, stands = 0.5f * (1.0f - v->gravity[2]);
    ROLLED for (int j = 0; j < T(JOINTS); j++) {
        float d = STATE(S_JOINT, j) - X(K(X_DEFAULT) + j);
        sum = fma_(d, d, sum);
    }
    float mean = sum / (float)(T(JOINTS) > 1 ? T(JOINTS) : 1);
    return stands * stands * exp_(-mean / (std * std));
}
FN float feet_off_ground(const Env *v, int form) {
    int off = 0, feet = K(form + FORM_COUNT);
    ROLLED for (int i = 0; i < feet; i++)
        off += peak_force(v, K(K(form + FORM_INTEGERS) + i)) <= F(K(form + FORM_NUMBERS));
    return (float)off / (float)feet;
}
/* direction of the base's x axis on the ground */
FN void forward_of(const float *q, float *o) {
    float c = 1.0f - 2.0f * (q[2] * q[2] + q[3] * q[3]), s = 2.0f * (q[1] * q[2] + q[0] * q[3]);
    float size = sqrtf(c * c + s * s);
    int has_heading = size > 1e-6f;
    o[0] = has_heading ? c / size : 1.0f;
    o[1] = has_heading ? s / size : 0.0f;
}
/* command/heading.rs, command/position.rs */
FN float heading_error(const Env *v, float wanted) {
    const Robot *a = v->a;
    return wrap_to_pi(wanted - heading(&STATE(S_ROTATION, 0)));
}
FN void position_error(const Env *v, float *o) {
    const Robot *a = v->a;
    float dx = COMMANDED(KIND_POSITION, 0) - STATE(S_POSITION, 0), f[2];
    float dy = COMMANDED(KIND_POSITION, 1) - STATE(S_POSITION, 1);
    forward_of(&STATE(S_ROTATION, 0), f);
    o[0] = f[0] * dx + f[1] * dy;
    o[1] = f[0] * dy - f[1] * dx;
    o[2] = heading_error(v, COMMANDED(KIND_POSITION, 2));
}
/* command/gait.rs */
FN float foot_clock(const Env *v, int foot) {
    float phase = COMMANDED(KIND_GAIT, 2), offset = COMMANDED(KIND_GAIT, 3), bound = COMMANDED(KIND_GAIT, 4);
    int pairs = K(K_FEET) / 2 > 1 ? K(K_FEET) / 2 : 1, is_right = foot >= pairs, is_hind = foot % pairs % 2 == 1;
    float lead = is_hind ? (is_right ? phase : bound) : is_right ? offset : phase + offset + bound;
    float at = COMMANDED(KIND_GAIT, 0) + lead, stance = limited(COMMANDED(KIND_GAIT, 5), 0.01f, 0.99f);
    at = at - floor_(at);
    return at < stance ? 0.5f * at / stance : 0.5f + 0.5f * (at - stance) / (1.0f - stance);
}
FN float smooth_step(float x) { return 1.0f / (1.0f + exp_(-1.702f * x / 0.07f)); }
FN float desired_contact(float clock) {
    return smooth_step(clock) * (1.0f - smooth_step(clock - 0.5f)) +
           smooth_step(clock - 1.0f) * (1.0f - smooth_step(clock - 1.5f));
}
FN float mean_over_feet(const Env *v, int forces, float sigma) {
    const Robot *a = v->a;
    float sum = -0.0f, least = 1.17549435e-38f;
    ROLLED for (int foot = 0; foot < K(K_FEET); foot++) {
        float wanted = desired_contact(foot_clock(v, foot)), x, share = forces ? 1.0f - wanted : wanted;
        if (forces) {
            int body = K(K_FOOT) + foot;
            float force = peak_force(v, K(body));
            x = -force * force;
        } else {
            x = -squares(&REPORT(R_SITE_VELOCITY, 3 * foot), 3);
        }
        sum += share * (1.0f - exp_(x / larger(sigma, least)));
    }
    return -sum / (float)(K(K_FEET) > 1 ? K(K_FEET) : 1);
}
/* command/jump.rs: whether the robot flies, rise of the base and speed */
FN int jump_now(const Env *v, float *rise, float *speed) {
    float time = COMMANDED(KIND_JUMP, 0), height = COMMANDED(KIND_JUMP, 1), fall = F(F_FREE_FALL);
    float flight = fall > 0.0f ? sqrtf(8.0f * height / fall) : 0.0f;
    *rise = *speed = 0.0f;
    if (time < 0.0f || time >= flight) return 0;
    float share = 2.0f * time / flight - 1.0f;
    *rise = height * (1.0f - share * share);
    *speed = COMMANDED(KIND_JUMP, 2) / flight;
    return 1;
}
FN float jump_height(const Env *v, int at) {
    float rise, speed;
    jump_now(v, &rise, &speed);
    float error = base_height(v) - F(at) - rise;
    return exp_(-error * error * F(at + 1));
}
FN float jump_velocity(const Env *v, float std) {
    const Robot *a = v->a;
    float rise, speed, f[2], x = STATE(S_LINEAR, 0), y = STATE(S_LINEAR, 1);
    jump_now(v, &rise, &speed);
    forward_of(&STATE(S_ROTATION, 0), f);
    float error[2] = {f[0] * x + f[1] * y - speed, f[0] * y - f[1] * x};
    return exp_(-squares(error, 2) / (std * std));
}
FN float jump_contacts(const Env *v) {
    float rise, speed;
    int flies = jump_now(v, &rise, &speed), right = 0;
    ROLLED for (int foot = 0; foot < K(K_FEET); foot++) {
        int body = K(K_FOOT) + foot;
        right += (peak_force(v, K(body)) <= 1.0f) == flies;
    }
    return (float)right / (float)(K(K_FEET) > 1 ? K(K_FEET) : 1);
}
/* reward/placement_terms.rs: places of the default feet come first, then their heights */
FN float raibert_heuristic(const Env *v, int at) {
    const Robot *a = v->a;
    float width = COMMANDED(KIND_FOOT_PLACEMENT, 0), length = COMMANDED(KIND_FOOT_PLACEMENT, 1), sum = 0.0f, f[2];
    float half_cycle = 0.5f / larger(COMMANDED(KIND_GAIT, 1), 0.1f), turn = X(K(X_COMMAND) + 2);
    forward_of(&STATE(S_ROTATION, 0), f);
    ROLLED for (int foot = 0; foot < K(K_FEET); foot++) {
        float x = F(at + 2 * foot) * length, y = F(at + 2 * foot + 1) * width;
        float phase = fabsf(1.0f - 2.0f * foot_clock(v, foot)) - 0.5f;
        float ahead_x = phase * (X(K(X_COMMAND)) - turn * y) * half_cycle;
        float ahead_y = phase * (X(K(X_COMMAND) + 1) + turn * x) * half_cycle;
        float to_x = REPORT(R_SITE_POSITION, 3 * foot) - STATE(S_POSITION, 0);
        float to_y = REPORT(R_SITE_POSITION, 3 * foot + 1) - STATE(S_POSITION, 1);
        float error_x = f[0] * to_x + f[1] * to_y - x - ahead_x, error_y = f[0] * to_y - f[1] * to_x - y - ahead_y;
        sum += error_x * error_x + error_y * error_y;
    }
    return sum;
}
FN float feet_clearance(const Env *v, int at) {
    float swing = COMMANDED(KIND_FOOT_PLACEMENT, 2), sum = 0.0f;
    ROLLED for (int foot = 0; foot < K(K_FEET); foot++) {
        float clock = foot_clock(v, foot);
        float phase = 1.0f - fabsf(1.0f - 2.0f * limited(2.0f * clock - 1.0f, 0.0f, 1.0f));
        float error = swing * phase + F(at + 2 * K(K_FEET) + foot) - foot_height(v, foot);
        sum += error * error * (1.0f - desired_contact(clock));
    }
    return sum;
}
FN float orientation_control(const Env *v) {
    float sin_roll, cos_roll, sin_pitch, cos_pitch;
    sin_cos(COMMANDED(KIND_POSE, 1), &sin_roll, &cos_roll);
    sin_cos(COMMANDED(KIND_POSE, 2), &sin_pitch, &cos_pitch);
    float error[2] = {v->gravity[0] - sin_pitch, v->gravity[1] + sin_roll * cos_pitch};
    return squares(error, 2);
}
FN float reward_of(const Env *v, int form) {
    const Robot *a = v->a;
    int at = K(form + FORM_NUMBERS), joints = T(JOINTS);
    const float *linear = v->linear, *angular = v->angular;
    float error[2], yaw_error = X(K(X_COMMAND) + 2) - angular[2];
    velocity_error(v, error);
    switch (K(form)) {
    case REWARD_TRACK_LIN_VEL_XY_EXP: return exp_(-squares(error, 2) / (F(at) * F(at)));
    case REWARD_TRACK_ANG_VEL_Z_EXP: return exp_(-yaw_error * yaw_error / (F(at) * F(at)));
    case REWARD_LIN_VEL_Z_L2: return linear[2] * linear[2];
    case REWARD_ANG_VEL_XY_L2: return squares(angular, 2);
    case REWARD_FLAT_ORIENTATION_L2: return squares(v->gravity, 2);
    case REWARD_BASE_ANGULAR_VELOCITY: return exp_(-fabsf(yaw_error) / F(at));
    case REWARD_BASE_LINEAR_VELOCITY: {
        float ramp = larger(1.0f + F(at + 2) * (command_norm(v, 2) - F(at + 1)), 1.0f);
        return exp_(-norm(error, 2) / F(at)) * ramp;
    }
    case REWARD_BASE_HEIGHT_L2: {
        float high = base_height(v) - F(at);
        return high * high;
    }
    case REWARD_BASE_MOTION:
        return 0.8f * linear[2] * linear[2] + 0.2f * (fabsf(angular[0]) + fabsf(angular[1]));
    case REWARD_BASE_ORIENTATION: return norm(v->gravity, 2);
    case REWARD_JOINT_ACC: return norm(&REPORT(R_ACCELERATION, 0), joints);
    case REWARD_JOINT_POS: {
        float distance = joint_distance(v);
        return is_moving(v, F(at + 1)) ? distance : F(at) * distance;
    }
    case REWARD_JOINT_TORQUES: return norm(&REPORT(R_EFFORT, 0), joints);
    case REWARD_IS_ALIVE: return HAS(TERMINATED) ? 0.0f : 1.0f;
    case REWARD_IS_TERMINATED: return HAS(TERMINATED) ? 1.0f : 0.0f;
    case REWARD_JOINT_VEL: return norm(&STATE(S_JOINT_VELOCITY, 0), joints);
    case REWARD_DOF_TORQUES_L2: return joint_squares(v, form, &REPORT(R_EFFORT, 0));
    case REWARD_DOF_ACC_L2: return joint_squares(v, form, &REPORT(R_ACCELERATION, 0));
    case REWARD_JOINT_VEL_L2: return joint_squares(v, form, &STATE(S_JOINT_VELOCITY, 0));
    case REWARD_JOINT_DEVIATION_L1: return joint_deviation(v, form, F(at));
    case REWARD_JOINT_POS_LIMITS: return joint_limits(v, form);
    case REWARD_STAND_STILL_JOINT_DEVIATION_L1:
        return command_norm(v, 2) < F(at + 1) ? joint_deviation(v, form, F(at)) : 0.0f;
    case REWARD_ACTION_RATE_L2: return F(at) * action_change(v);
    case REWARD_ACTION_SMOOTHNESS: return sqrtf(action_change(v));
    case REWARD_FEET_AIR_TIME: return feet_air_time(v, F(at), F(at + 1));
    case REWARD_UNDESIRED_CONTACTS: return (float)count_contacts(v, form);
    case REWARD_AIR_TIME: return air_time(v, F(at), F(at + 1));
    case REWARD_AIR_TIME_VARIANCE: return variance_of_times(v, 3, F(at)) + variance_of_times(v, 2, F(at));
    case REWARD_FOOT_CLEARANCE: return foot_clearance(v, at);
    case REWARD_FOOT_SLIP:
    case REWARD_FEET_SLIDE: return speed_of_standing(v, F(at));
    case REWARD_GAIT: return gait(v, at);
    case REWARD_FEET_AIR_TIME_POSITIVE_BIPED: return single_stance(v, F(at), F(at + 1));
    case REWARD_DESIRED_CONTACTS: {
        int stands = 0;
        ROLLED for (int foot = 0; foot < K(K_FEET); foot++) stands |= stands_with(v, foot, F(at));
        return stands ? 0.0f : 1.0f;
    }
    case REWARD_GAIT_SYMMETRY: return gait_symmetry(v);
    case REWARD_UPRIGHT: return upright(v, at);
    case REWARD_TORSO_HEIGHT: {
        float missing = larger(F(at) - base_height(v), 0.0f);
        return exp_(-missing * missing * F(at + 1));
    }
    case REWARD_POSTURE: return posture(v, F(at));
    case REWARD_FEET_OFF_GROUND: return feet_off_ground(v, form);
    case REWARD_TRACK_BASE_HEIGHT_EXP: {
        float off = COMMANDED(KIND_POSE, 0) - base_height(v);
        return exp_(-off * off / (F(at) * F(at)));
    }
    case REWARD_ORIENTATION_CONTROL: return orientation_control(v);
    case REWARD_HEADING_COMMAND_ERROR_ABS: {
        int is_position = K(K(form + FORM_INTEGERS));
        float wanted = is_position ? COMMANDED(KIND_POSITION, 2) : COMMANDED(KIND_HEADING, 0);
        return fabsf(heading_error(v, wanted));
    }
    case REWARD_POSITION_COMMAND_ERROR_TANH: {
        float way[3];
        position_error(v, way);
        return 1.0f - tanh_positive(norm(way, 2) / F(at));
    }
    case REWARD_TRACKING_CONTACTS_SHAPED_FORCE: return mean_over_feet(v, 1, F(at));
    case REWARD_TRACKING_CONTACTS_SHAPED_VEL: return mean_over_feet(v, 0, F(at));
    case REWARD_JUMP_HEIGHT_EXP: return jump_height(v, at);
    case REWARD_JUMP_VELOCITY_EXP: return jump_velocity(v, F(at));
    case REWARD_JUMP_CONTACTS: return jump_contacts(v);
    case REWARD_RAIBERT_HEURISTIC: return raibert_heuristic(v, at);
    case REWARD_FEET_CLEARANCE_CMD_LINEAR: return feet_clearance(v, at);
    case REWARD_SCALED_TORQUES_L2: {
        float load = X(K(X_MASS)) * F(F_FREE_FALL) * standing_height(v, F(at));
        return load > 0.0f ? mean_square(&REPORT(R_EFFORT, 0), joints) / (load * load) : 0.0f;
    }
    default: {
        float fall = F(F_FREE_FALL), unit = fall > 0.0f ? standing_height(v, F(at)) / fall : 0.0f;
        return mean_square(&REPORT(R_ACCELERATION, 0), joints) * (unit * unit);
    }
    }
}
/* logs.rs: the tracking errors of the step */
FN void add_errors(Env *v) {
    int total = K(X_TOTAL), command = K(X_COMMAND);
    float x = X(command), y = X(command + 1), yaw = X(command + 2);
    X(total + 1) = X(total + 1) + length(x - v->linear[0], y - v->linear[1]);
    X(total + 2) = X(total + 2) + fabsf(yaw - v->angular[2]);
    X(total + 3) = X(total + 3) + length(x, y);
    X(total + 4) = X(total + 4) + fabsf(yaw);
    X(total + 5) = X(total + 5) + length(v->linear[0], v->linear[1]);
    U(U_STEPS) = U(U_STEPS) + 1;
}
FN float weight_of(const Env *v, int form) {
    return F(stage_of(v, K(form + FORM_MORE + 2), K(form + FORM_MORE + 1), K(form + FORM_MORE)));
}
FN void reward(Env *v) {
    int resetting = K(K_AUTORESET) == AT_NEXT_STEP && HAS(NEEDS_RESET) && !HAS(TERMINATED | TRUNCATED);
    v->total = 0.0f;
    if (HAS(INVALID) || resetting) return;
    add_errors(v);
    float total = 0.0f;
    ROLLED for (int i = 0; i < K(K_NUM_REWARDS); i++) {
        int form = K(K_REWARD) + i * FORM_SIZE, sum = K(X_SUM) + i;
        float value = weight_of(v, form) * reward_of(v, form) * F(F_STEP);
        X(sum) = X(sum) + value;
        total += value;
    }
    X(K(X_TOTAL)) = X(K(X_TOTAL)) + total;
    v->total = total;
}

/* observe.rs */
FN float observed(const Env *v, int term, int i) {
    const Robot *a = v->a;
    int slot = K(K_SLOT) + i * SLOT_SIZE, joint;
    switch (K(term)) {
    case OBSERVATION_BASE_LIN_VEL: return v->linear[i];
    case OBSERVATION_BASE_ANG_VEL: return v->angular[i];
    case OBSERVATION_PROJECTED_GRAVITY: return v->gravity[i];
    case OBSERVATION_VELOCITY_COMMANDS: return X(K(X_COMMAND) + i);
    case OBSERVATION_HEIGHT_SCAN:
        return STATE(S_POSITION, 2) - F(K(term + FORM_NUMBERS) + FILTER_SIZE) - X(K(X_SCAN) + i);
    case OBSERVATION_LAST_ACTION: return X(K(X_ACTION) + i);
    case OBSERVATION_FEET_AIR_TIME: return TIME(1, i);
    case OBSERVATION_FEET_HEIGHT: return foot_height(v, i);
    case OBSERVATION_CLOCK_INPUTS: {
        float sine, cosine;
        sin_cos((float)6.28318530717958647692 * foot_clock(v, i), &sine, &cosine);
        return sine;
    }
    case OBSERVATION_HEADING_COMMANDS: return heading_error(v, COMMANDED(KIND_HEADING, 0));
    case OBSERVATION_POSITION_COMMANDS: {
        float way[3];
        position_error(v, way);
        return way[i];
    }
    case OBSERVATION_POSE_COMMANDS: return COMMANDED(KIND_POSE, i);
    case OBSERVATION_GAIT_COMMANDS: return COMMANDED(KIND_GAIT, i ? 5 : 1);
    case OBSERVATION_JUMP_COMMANDS: {
        float number = COMMANDED(KIND_JUMP, i);
        return i ? number : limited(number, -1.0f, 1.0f);
    }
    case OBSERVATION_FOOT_PLACEMENT_COMMANDS: return COMMANDED(KIND_FOOT_PLACEMENT, i);
    case OBSERVATION_FEET_CONTACT_FORCE: slot = K(K_FOOT) + i; return peak_force(v, K(slot));
    case OBSERVATION_KEPT_OF_JOINTS:
    case OBSERVATION_KEPT: return X(K(X_KEPT) + K(K(term + FORM_INTEGERS)) + i);
    case OBSERVATION_CONTACT_FRICTION: return X(K(X_BODY) + BODY_FRICTION + i);
    case OBSERVATION_BASE_MASS_OFFSET: return X(K(X_BODY)) - F(K(term + FORM_NUMBERS) + FILTER_SIZE);
    case OBSERVATION_BASE_COM_OFFSET:
        return X(K(X_BODY) + BODY_COM + i) - F(K(term + FORM_NUMBERS) + FILTER_SIZE + i);
    default: break;
    }
    joint = K(slot);
    float number = K(term) == OBSERVATION_JOINT_POS_REL ? STATE(S_JOINT, joint) - X(K(X_DEFAULT) + joint)
                                                        : STATE(S_JOINT_VELOCITY, joint);
    return F(K(slot + 2)) * number;
}
FN void observe(Env *v, float *row) {
    if (HAS(INVALID)) {
        ROLLED for (int i = 0; i < K(K_OBSERVED); i++) row[i] = 0.0f;
        return;
    }
    ROLLED for (int t = 0; t < K(K_NUM_TERMS); t++) {
        int term = K(K_TERM) + t * FORM_SIZE, at = K(term + FORM_NUMBERS), size = K(term + FORM_MORE + 1);
        int memory = K(term + FORM_MORE + 2), what = K(term), slots = K(K_SLOTS), columns = K(K_ACTIONS);
        int per_joint = what >= OBSERVATION_JOINT_POS_REL && what <= OBSERVATION_KEPT_OF_JOINTS;
        int per_foot = what >= OBSERVATION_FEET_CONTACT_FORCE && what <= OBSERVATION_FEET_HEIGHT;
        int own = per_joint ? size / columns * slots : per_foot ? K(K_FEET) : size;
        float error = F(at + FILTER_ERROR);
        if (error > 0.0f && !HAS(FRESH)) continue;
        float *to = row + K(term + FORM_MORE), noise = F(at), low = F(at + 1), high = F(at + 2), scale = F(at + 3);
        ROLLED for (int i = 0; i < size * (memory - 1); i++) to[i] = to[i + size];
        float *newest = to + size * (memory - 1);
        if (own != size && HAS(FRESH)) ROLLED for (int i = 0; i < size; i++) newest[i] = 0.0f;
        ROLLED for (int i = 0; i < own; i++) {
            int column = per_joint ? K(K_SLOT) + i % slots * SLOT_SIZE + 1 : K(K_FOOT_COLUMN) + i;
            float number = observed(v, term, i);
            if (error > 0.0f) number *= between(v, 1.0f - error, 1.0f + error);
            if (noise > 0.0f) number += between(v, -noise, noise);
            if (low <= high) number = smaller(larger(number, low), high);
            if (scale != 1.0f) number *= scale;
            newest[per_joint ? i / slots * columns + K(column) : per_foot ? K(column) : i] = number;
        }
        if (HAS(FRESH)) ROLLED for (int i = 0; i < size * (memory - 1); i++) to[i] = newest[i % size];
    }
}

/* startup.rs: events that change the body of the next episode */
FN float combined_friction(const Env *v, float ground, float robot) {
    switch (K(K_COMBINE)) {
    case COMBINE_AVERAGE: return 0.5f * (ground + robot);
    case COMBINE_GEOMETRIC_MEAN: return sqrtf(ground * robot);
    case COMBINE_MIN: return smaller(ground, robot);
    case COMBINE_MULTIPLY: return ground * robot;
    default: return larger(ground, robot);
    }
}
/* one of the values of a list, the same share of whose range each has */
FN float draw_bucket(Env *v, int first, int last) {
    int at = last ? (int)(unsigned)steps_between(v, 0, (unsigned)last) : 0;
    return F(first + at);
}
FN void draw_material(Env *v, int at, int list) {
    int body = K(X_BODY) + BODY_FRICTION, last = K(list), lists = last + 1;
    float sticking = draw_bucket(v, at, last);
    float sliding = smaller(draw_bucket(v, at + lists, last), sticking);
    X(body) = combined_friction(v, F(F_GROUND_FRICTION), sticking);
    X(body + 1) = combined_friction(v, F(F_GROUND_FRICTION + 1), sliding);
    at += 2 * lists;
    for (int spin = 0; spin < 2; spin++) {
        if (!K(list + 1 + spin)) continue;
        X(body + 2 + spin) = larger(F(F_GROUND_FRICTION + 2 + spin), draw_bucket(v, at, last));
        at += lists;
    }
}
FN void add_base_mass(Env *v, int at, int list) {
    int body = K(X_BODY);
    float old = X(body), drawn = uniform(v, at), now = larger(K(list + 1) ? old * drawn : old + drawn, 0.01f);
    X(body) = now;
    if (!K(list)) return;
    for (int k = 0; k < 6; k++) X(body + BODY_INERTIA + k) = X(body + BODY_INERTIA + k) * (now / old);
}
/* Draws for each joint; the shares of its effort limit that its effort table leaves come after the ranges. */
FN void draw_lists(Env *v, int form) {
    const Robot *a = v->a;
    int joints = T(JOINTS), draws = K(form + FORM_COUNT) / BODY_DRAW_SIZE, at = K(form + FORM_NUMBERS);
    int lists = K(X_BODY) + BODY_JOINTS;
    ROLLED for (int i = 0; i < draws; i++) {
        int draw = K(form + FORM_INTEGERS) + i * BODY_DRAW_SIZE, list = lists + K(draw) * joints;
        ROLLED for (int j = 0; j < joints; j++) {
            float effort = X(lists + LIST_EFFORT_LIMIT * joints + j) * F(at + 2 * draws + j);
            float drawn = uniform(v, at + 2 * i), value = X(list + j);
            switch (K(draw + 1)) {
            case OPERATION_ADD: value = value + drawn; break;
            case OPERATION_SCALE: value = value * drawn; break;
            case OPERATION_ABS: value = drawn; break;
            default: value = is_finite(effort) ? fma_(drawn, effort, value) : value;
            }
            X(list + j) = larger(value, 0.0f);
        }
    }
}
/* Networks have no gains, whatever was drawn. */
FN void take_gains_off(Env *v) {
    const Robot *a = v->a;
    int stiffness = K(X_BODY) + BODY_JOINTS + LIST_STIFFNESS * T(JOINTS), damping = stiffness + T(JOINTS);
    ROLLED for (int n = 0; n < T(NETWORKS); n++) {
        int network = T(T_NETWORK) + n * NETWORK_SIZE;
        ROLLED for (int k = 0; k < L(network); k++) {
            int joint = L(L(network + NET_JOINT) + k);
            X(stiffness + joint) = X(damping + joint) = 0.0f;
        }
    }
}
FN void scale_motors(Env *v, int at) {
    const Robot *a = v->a;
    int joints = T(JOINTS), lists = K(X_BODY) + BODY_JOINTS;
    ROLLED for (int j = 0; j < joints; j++) {
        float share = uniform(v, at);
        for (int list = LIST_STIFFNESS; list <= LIST_SATURATION_EFFORT; list++) {
            float x = X(lists + list * joints + j);
            if (list <= LIST_DAMPING || is_finite(x)) X(lists + list * joints + j) = x * share;
        }
    }
}
FN void change_body(Env *v, int form) {
    int at = K(form + FORM_NUMBERS), list = K(form + FORM_INTEGERS), com = K(X_BODY) + BODY_COM;
    switch (K(form)) {
    case BODY_EVENT_PHYSICS_MATERIAL: draw_material(v, at, list); return;
    case BODY_EVENT_ADD_BASE_MASS: add_base_mass(v, at, list); return;
    case BODY_EVENT_BASE_COM:
        for (int d = 0; d < 3; d++) X(com + d) = X(com + d) + uniform(v, at + 2 * d);
        return;
    case BODY_EVENT_RANDOMIZE_MOTOR_STRENGTH: scale_motors(v, at); return;
    default:
        draw_lists(v, form);
        if (K(form) == BODY_EVENT_RANDOMIZE_ACTUATOR_GAINS) take_gains_off(v);
    }
}
FN int size_of_body(const Env *v) {
    const Robot *a = v->a;
    return BODY_JOINTS + BODY_LISTS * T(JOINTS);
}
/* Gives the robot's own parameters new values. READ shows them from the next kernel on. */
FN void set_parameters(Env *v, int is_own, int at, int from, int count) {
    float *own = (float *)v->a->p + (size_t)at * TILE;
    if (is_own)
        ROLLED for (int i = 0; i < count; i++) own[(size_t)i * TILE] = X(K(X_BODY) + from + i);
}
#define SET(name, from, count) set_parameters(v, IS_OWN(name), T(name), from, count)
#define SET_LIST(name, list) SET(name, BODY_JOINTS + (list) * T(JOINTS), T(JOINTS))
FN void reset_body(Env *v) {
    const Robot *a = v->a;
    int body = K(X_BODY), size = size_of_body(v);
    if (!K(K_NUM_BODY_EVENTS)) return;
    ROLLED for (int i = 0; i < size; i++) X(body + i) = X(K(X_STARTUP) + i);
    ROLLED for (int i = 0; i < K(K_NUM_BODY_EVENTS); i++) change_body(v, K(K_BODY_EVENT) + i * FORM_SIZE);
    SET(P_MASS, 0, 1);
    SET(P_COM, BODY_COM, 3);
    SET(P_INERTIA, BODY_INERTIA, 6);
    SET(P_STATIC_FRICTION, BODY_FRICTION, 1);
    SET(P_DYNAMIC_FRICTION, BODY_FRICTION + 1, 1);
    SET(P_TORSIONAL_FRICTION, BODY_FRICTION + 2, 1);
    SET(P_ROLLING_FRICTION, BODY_FRICTION + 3, 1);
    SET_LIST(P_STIFFNESS, LIST_STIFFNESS);
    SET_LIST(P_DAMPING, LIST_DAMPING);
    SET_LIST(P_EFFORT_LIMIT, LIST_EFFORT_LIMIT);
    SET_LIST(P_SATURATION_EFFORT, LIST_SATURATION_EFFORT);
    SET_LIST(P_ARMATURE, LIST_ARMATURE);
    SET_LIST(P_JOINT_FRICTION, LIST_JOINT_FRICTION);
    SET_LIST(P_JOINT_DAMPING, LIST_JOINT_DAMPING);
    float mass = X(body);
    ROLLED for (int link = 1; link <= T(JOINTS); link++) mass += P(P_MASS, link);
    X(K(X_MASS)) = mass;
}

/* robot/articulation.rs */
FN void soft_limits(float lower, float upper, float share, float *o) {
    o[0] = lower;
    o[1] = upper;
    if (!is_finite(lower) || !is_finite(upper)) return;
    float middle = 0.5f * (lower + upper), half = 0.5f * (upper - lower) * share;
    o[0] = middle - half;
    o[1] = middle + half;
}
/* reset.rs */
FN void reset_base(Env *v, int at, int more) {
    const Robot *a = v->a;
    float s, c, sr, cr, sp, cp, world[3], r[9];
    STATE(S_POSITION, 0) = STATE(S_POSITION, 0) + uniform(v, at);
    STATE(S_POSITION, 1) = STATE(S_POSITION, 1) + uniform(v, at + 2);
    sin_cos(0.5f * uniform(v, at + 4), &s, &c);
    STATE(S_ROTATION, 0) = c;
    STATE(S_ROTATION, 1) = STATE(S_ROTATION, 2) = 0.0f;
    STATE(S_ROTATION, 3) = s;
    if (more) {
        sin_cos(0.5f * uniform(v, at + 6), &sr, &cr);
        sin_cos(0.5f * uniform(v, at + 8), &sp, &cp);
        STATE(S_ROTATION, 0) = c * cp * cr + s * sp * sr;
        STATE(S_ROTATION, 1) = c * cp * sr - s * sp * cr;
        STATE(S_ROTATION, 2) = c * sp * cr + s * cp * sr;
        STATE(S_ROTATION, 3) = s * cp * cr - c * sp * sr;
    }
    for (int d = 0; d < 3; d++) STATE(S_LINEAR, d) = uniform(v, F_BASE_VELOCITY);
    for (int d = 0; d < 3; d++) world[d] = uniform(v, F_BASE_VELOCITY);
    quat_to_mat(&STATE(S_ROTATION, 0), r);
    mul_vec_transposed(r, world, &STATE(S_ANGULAR, 0));
}
FN void reset_joints(Env *v) {
    const Robot *a = v->a;
    float soft[2];
    ROLLED for (int j = 0; j < T(JOINTS); j++) {
        float drawn = uniform(v, F_JOINT_POSITION), q = STATE(S_JOINT, j);
        soft_limits(P(P_LOWER, j), P(P_UPPER, j), F(F_SOFT), soft);
        STATE(S_JOINT, j) = smaller(larger(K(K_SCALES) ? q * drawn : q + drawn, soft[0]), soft[1]);
    }
    ROLLED for (int j = 0; j < T(JOINTS); j++) STATE(S_JOINT_VELOCITY, j) = uniform(v, F_JOINT_VELOCITY);
}
FN void reset_joints_within_limits(Env *v, int at) {
    const Robot *a = v->a;
    float soft[2];
    ROLLED for (int j = 0; j < T(JOINTS); j++) {
        float drawn = uniform(v, at);
        soft_limits(P(P_LOWER, j), P(P_UPPER, j), F(F_SOFT), soft);
        if (is_finite(soft[1] - soft[0])) STATE(S_JOINT, j) = fma_(soft[1] - soft[0], drawn, soft[0]);
        STATE(S_JOINT_VELOCITY, j) = 0.0f;
    }
}
FN void draw_delays(Env *v) {
    const Robot *a = v->a;
    ROLLED for (int j = 0; j < T(JOINTS); j++) DRIVE(D_DELAY, j) = 0.0f;
    ROLLED for (int i = 0; i < K(K_NUM_DELAYS); i++) {
        int group = K(K_DELAY) + i * DELAY_SIZE;
        float steps = steps_between(v, (unsigned)K(group), (unsigned)K(group + 1));
        ROLLED for (int j = 0; j < K(group + 2); j++) DRIVE(D_DELAY, K(K(group + 3) + j)) = steps;
    }
}
FN void change_new_state(Env *v, int form) {
    const Robot *a = v->a;
    int at = K(form + FORM_NUMBERS), list = K(form + FORM_INTEGERS);
    switch (K(form)) {
    case RESET_RESET_BASE: reset_base(v, at, K(list)); return;
    case RESET_RESET_JOINTS: reset_joints(v); return;
    case RESET_RESET_JOINTS_WITHIN_LIMITS_RANGE: reset_joints_within_limits(v, at); return;
    case RESET_BASE_EXTERNAL_FORCE_TORQUE: draw_wrench(v, at); return;
    default: {
        float steps = steps_between(v, (unsigned)K(list), (unsigned)K(list + 1));
        ROLLED for (int j = 0; j < T(JOINTS); j++) DRIVE(D_DELAY, j) = DRIVE(D_DELAY, j) + steps;
    }
    }
}
/* curriculum.rs: the level of the next episode */
FN void widen_commands(Env *v, int form) {
    int at = K(form + FORM_NUMBERS), term = K(K(form + FORM_INTEGERS)), tracking = K(X_TRACKING);
    float most = weight_of(v, K(K_REWARD) + term * FORM_SIZE) * F(at), *widening = &X(K(X_WIDENING));
    if (most <= 0.0f) return;
    X(tracking) = X(tracking) + 0.2f * (X(K(X_SUM) + term) / most - X(tracking));
    if (X(tracking) > F(at + 1)) *widening = smaller(*widening + F(at + 2), F(at + 3));
}
FN void move_to_level(Env *v, int form) {
    const Robot *a = v->a;
    int at = K(form + FORM_NUMBERS), command = K(X_COMMAND);
    unsigned level = U(U_LEVEL), rows = (unsigned)K(K_TILES), left = 0, longest = (unsigned)K(K_LONGEST);
    if (!rows) return;
    /* the time that a fall cuts off counts as the robot's */
    if (((unsigned)K(K_FAILURES) & U(U_CAUSES)) && longest > U(U_LENGTH)) left = longest - U(U_LENGTH);
    float lived = (float)U(U_LIVED) * F(F_STEP), given = (float)(U(U_LIVED) + left) * F(F_STEP);
    float walked = length(STATE(S_POSITION, 0), STATE(S_POSITION, 1));
    float asked = length(X(command), X(command + 1)) * given;
    if (walked > 0.5f * F(F_TILE))
        level = level + 1;
    else if (walked < asked * F(at) && lived >= F(at + 1))
        level = level > 0 ? level - 1 : 0;
    else
        return;
    if (level >= rows) level = (unsigned)steps_between(v, 0, rows - 1);
    U(U_LEVEL) = level;
    for (int d = 0; d < 2; d++) {
        float tile = (float)(d ? U(U_COLUMN) : level);
        X(K(X_ORIGIN) + d) = (tile + 0.5f - 0.5f * (float)K(K_TILES + d)) * F(F_TILE + d);
        DRIVE(D_ORIGIN, d) = X(K(X_ORIGIN) + d);
    }
}
FN void end_episode(Env *v, int form) {
    switch (K(form)) {
    case CURRICULUM_TERRAIN_LEVELS: move_to_level(v, form); return;
    case CURRICULUM_COMMAND_CURRICULUM: widen_commands(v, form); return;
    default: return;
    }
}
/* place.rs: height of a contact candidate's lowest point above the base's origin, and its centre */
FN float lowest_of(const Robot *a, int contact, const float *up, float *centre) {
    int list = T(T_CONTACT) + contact * CONTACT_SIZE, link = LINK(L(list));
    float r[9], at[3], own[3];
    w_load(a, link, 9, r);
    w_load(a, link + LINK_POSITION, 3, at);
    p_load(a, P_CONTACT_POSITION, 3 * contact, 3, centre);
    mul_vec(r, centre, centre);
    add(at, centre, centre);
    float below = P(P_CONTACT_RADIUS, contact);
    if (L(list + 2)) {
        const float *e = C(T(C_RIM) + contact * RIM_SIZE);
        mul_vec_transposed(r, up, own);
        float c = dot(e, own), s = dot(e + 3, own);
        below += P(P_CONTACT_RIM, contact) * sqrtf(fma_(c, c, s * s));
    }
    return dot(up, centre) - below;
}
FN float lowest_point(const Robot *a, const float *up) {
    float lowest = 3.40282347e38f, centre[3];
    ROLLED for (int contact = 0; contact < T(CONTACTS); contact++)
        lowest = smaller(lowest, lowest_of(a, contact, up, centre));
    return lowest;
}
/* Lifts the base onto the highest ground about it; returns the height that is missing there. */
FN float missing_on_grid(const Env *v, const float *r) {
    const Robot *a = v->a;
    float at[2], centre[3], missing = -3.40282347e38f;
    for (int d = 0; d < 2; d++) at[d] = D(T(D_ORIGIN) + d) + STATE(S_POSITION, d);
    float highest = highest_near(a, at[0], at[1], FOOTPRINT);
    STATE(S_POSITION, 2) = STATE(S_POSITION, 2) + (highest - F(F_HEIGHT));
    float least = F(F_MARGIN) - STATE(S_POSITION, 2);
    ROLLED for (int contact = 0; contact < T(CONTACTS); contact++) {
        float low = lowest_of(a, contact, r + 6, centre), x = dot(r, centre), y = dot(r + 3, centre);
        float reach = P(P_CONTACT_RADIUS, contact) + P(P_CONTACT_RIM, contact);
        int is_within = larger(fabsf(x), fabsf(y)) + reach <= FOOTPRINT;
        /* most candidates are above all ground around them */
        float bound = is_within ? highest : TC(GRID_HIGHEST);
        if (least + bound - low > larger(PLACE_TOLERANCE, missing))
            missing = larger(missing, least + highest_near(a, at[0] + x, at[1] + y, reach) - low);
    }
    return missing;
}
FN void place_robot(Env *v) {
    Robot *a = v->a;
    float r[9], base[6];
    ROLLED for (int k = 0; k < T(S_MEMORY); k++) S(k) = a->row[k];
    quat_to_mat(&STATE(S_ROTATION, 0), r);
    copy(base, &STATE(S_ANGULAR, 0), 3);
    mul_vec_transposed(r, &STATE(S_LINEAR, 0), base + 3);
    forward_kinematics(a, base);
    float missing = T(HAS_GRID) ? missing_on_grid(v, r)
                                : F(F_MARGIN) - (STATE(S_POSITION, 2) + lowest_point(a, r + 6) - F(F_HEIGHT));
    if (missing > PLACE_TOLERANCE) STATE(S_POSITION, 2) = STATE(S_POSITION, 2) + missing;
    S(T(S_POSITION) + 2) = STATE(S_POSITION, 2);
    report_sites(a);
}
FN void clear_report(const Robot *a) {
    ROLLED for (int k = T(R_EFFORT); k < T(R_SITE_POSITION); k++) a->r[k] = 0.0f;
    ROLLED for (int k = T(S_BOUND); k < T(S_PRESSING); k++) a->row[k] = 0.0f;
    STATE(S_PRESSING, 0) = 0.0f;
}
FN void reset(Env *v) {
    const Robot *a = v->a;
    reset_body(v);
    if (U(U_LIVED) > 0)
        ROLLED for (int i = 0; i < K(K_NUM_CURRICULA); i++) end_episode(v, K(K_CURRICULUM) + i * FORM_SIZE);
    STATE(S_POSITION, 0) = STATE(S_POSITION, 1) = 0.0f;
    STATE(S_POSITION, 2) = X(K(X_SPAWN));
    STATE(S_ROTATION, 0) = 1.0f;
    for (int d = 0; d < 3; d++)
        STATE(S_ROTATION, 1 + d) = STATE(S_LINEAR, d) = STATE(S_ANGULAR, d) = DRIVE(D_FORCE, d) = DRIVE(D_TORQUE, d) =
            0.0f;
    ROLLED for (int j = 0; j < T(JOINTS); j++) {
        STATE(S_JOINT, j) = X(K(X_DEFAULT) + j);
        STATE(S_JOINT_VELOCITY, j) = 0.0f;
    }
    draw_delays(v);
    ROLLED for (int i = 0; i < K(K_NUM_RESETS); i++) change_new_state(v, K(K_RESET) + i * FORM_SIZE);
    ROLLED for (int i = 0; i < K(K_SLOTS); i++) X(K(X_ACTION) + i) = X(K(X_PREVIOUS) + i) = 0.0f;
    ROLLED for (int i = 0; i < T(AGES) * T(JOINTS); i++) DRIVE(D_TARGET, i) = X(K(X_DEFAULT) + i % T(JOINTS));
    clear_report(a);
    ROLLED for (int i = 0; i < K(K_NUM_INTERVALS); i++)
        X(K(X_TIMER) + i) = uniform(v, K(K(K_INTERVAL) + i * FORM_SIZE + FORM_NUMBERS));
    if (K(K_HAS_COMMAND) && !HAS(PINNED)) {
        draw_command(v);
        steer(v, &STATE(S_ROTATION, 0));
    }
    ROLLED for (int i = 0; i < K(K_NUM_COMMANDS); i++) {
        if (U(U_PINNED) >> i & 1) continue;
        draw_numbers(v, K(K_COMMANDS) + i * FORM_SIZE);
        X(K(X_WAIT) + i) = F(K(K(K_COMMANDS) + i * FORM_SIZE + FORM_NUMBERS));
    }
    ROLLED for (int i = 0; i < TOTALS; i++) X(K(X_TOTAL) + i) = 0.0f;
    ROLLED for (int i = 0; i < K(K_NUM_REWARDS); i++) X(K(X_SUM) + i) = 0.0f;
    ROLLED for (int i = 0; i < TIMES * K(K_FEET); i++) X(K(X_TIME) + i) = 0.0f;
    U(U_LENGTH) = U(U_LIVED) = U(U_CAUSES) = U(U_STEPS) = 0;
    v->flags &= HOLDS_HEADING | STANDING | PINNED;
    v->flags |= FRESH | FRESH_TARGETS;
    place_robot(v);
    read_imu(v);
    scan_ground(v);
}
FN int is_due(const Env *v) {
    int mode = K(K_AUTORESET);
    return HAS(NEEDS_RESET) && (mode == AT_SAME_STEP || (mode == AT_NEXT_STEP && !HAS(TERMINATED | TRUNCATED)));
}

/* Keeps the rows of drive and state, and the efforts of the report, for the record of a broken state.
 * Behind the rows are the length of the episode, whether they stay, and the body, if resets change it. */
FN void keep_rows(const Env *v, float *to) {
    const Robot *a = v->a;
    int listed = (int)STATE(S_PRESSING, 0), state = T(S_PRESSING) + 1 + LISTED_SIZE * listed;
    state = state < v->row ? state : v->row;
    ROLLED for (int i = 0; i < T(SIZE_DRIVE); i++) to[i] = v->drive[i];
    ROLLED for (int i = 0; i < state; i++) to[T(SIZE_DRIVE) + i] = a->row[i];
    ROLLED for (int i = T(R_EFFORT); i < T(R_BODY_FORCE); i++) to[T(SIZE_DRIVE) + v->row + i] = a->r[i];
}
FN int size_of_kept(const Env *v) {
    const Robot *a = v->a;
    return T(SIZE_DRIVE) + v->row + T(SIZE_REPORT);
}

/* Whether rows of a broken state are there, which stay until the host has read them. */
FN int has_kept(const Env *v) { return v->kept[2 * size_of_kept(v) + 1] > 0.0f; }
FN int acts_within_bounds(const Env *v) {
    int all = 1;
    ROLLED for (int i = 0; i < K(K_ACTIONS); i++) all &= fabsf(v->action[i]) <= F(F_MAX_ACTION);
    return all;
}

/* the sets before the physics, and those after it */
FN void before_physics(Env *v) {
    act(v);
    update_command(v);
    update_numbers(v);
    count_step(v);
    disturb(v);
    if (v->kept && !has_kept(v)) keep_rows(v, v->kept);
}
/* Writes an episode that has ended, for the logs. */
FN void write_ended(const Env *v, int env, unsigned *to) {
    union { float number; unsigned bits; } word;
    to[0] = (unsigned)env;
    to[1] = v->flags;
    to[2] = U(U_CAUSES);
    to[3] = U(U_STEPS);
    to[4] = U(U_LEVEL);
    word.number = X(K(X_WIDENING));
    to[5] = word.bits;
    ROLLED for (int i = 0; i < TOTALS + K(K_NUM_REWARDS); i++) {
        word.number = i < TOTALS ? X(K(X_TOTAL) + i) : X(K(X_SUM) + i - TOTALS);
        to[ENDED_SIZE + i] = word.bits;
    }
}
/* Returns the flags of the step, before a reset clears them. */
FN unsigned after_physics(Env *v, int env, unsigned *ended) {
    unsigned broken = 0;
    if (v->kept && !is_allowed(v)) {
        if (!has_kept(v)) {
            keep_rows(v, v->kept + size_of_kept(v));
            v->kept[2 * size_of_kept(v)] = (float)U(U_LENGTH);
            v->kept[2 * size_of_kept(v) + 1] = 1.0f;
            if (K(K_NUM_BODY_EVENTS))
                ROLLED for (int i = 0; i < size_of_body(v); i++) v->kept[2 * size_of_kept(v) + 2 + i] = X(K(X_BODY) + i);
        }
        broken = BROKEN;
    }
    read_imu(v);
    scan_ground(v);
    count_times(v);
    terminate(v);
    reward(v);
    unsigned flags = (v->flags & (TERMINATED | TRUNCATED | INVALID)) | broken;
    if (K(K_AUTORESET) == AT_SAME_STEP && HAS(TERMINATED | TRUNCATED)) {
        if (K(K_REMEMBERS))
            ROLLED for (int i = 0; i < K(K_OBSERVED); i++) v->final[i] = v->observation[i];
        observe(v, v->final);
        flags |= HAS_FINAL;
    }
    if (HAS(TERMINATED | TRUNCATED) && !HAS(LOGGED)) {
        v->flags |= LOGGED;
        write_ended(v, env, ended);
        flags |= LOGGED;
    }
    if (is_due(v)) reset(v);
    observe(v, v->observation);
    return flags;
}
#endif
