/* One control step of a robot: crates/dynamics/src/step.rs, actuators.rs, springs.rs and report.rs. */
#ifndef POLYPOD_STEP_H
#define POLYPOD_STEP_H
#include "kinematics.h"
#include "networks.h"
#include "pairs.h"
#include "solver.h"

/* Selects the position target that each actuator sees: the one from `delay` physics steps ago. */
FN void select_targets(Robot *a, int substep) {
    SHARED_OUT(j, T(JOINTS)) {
        float target = D(T(D_TARGET) + j);
        if (T(HAS_DELAY)) {
            ROLLED for (int age = 1; age < T(AGES); age++) {
                float from = (float)(substep + (age - 1) * T(DECIMATION)) + 0.5f;
                if (from < D(T(D_DELAY) + j)) target = D(T(D_TARGET) + age * T(JOINTS) + j);
            }
        }
        W(T(W_TARGET) + j) = target;
    }
}

/* Effort limit from a table over the joint position, N m. */
FN float table_limit(const float *table, int length, float position) {
    int last = length - 1;
    float x = (position - table[0]) * table[1];
    if (x < 0.0f) x = 0.0f;
    if (x > (float)last) x = (float)last;
    int before_last = last > 0 ? last - 1 : 0;
    int i = x == x ? (int)x : 0;
    if (i > before_last) i = before_last;
    float first = table[2 + i], second = table[2 + (i + 1 < last ? i + 1 : last)];
    return fma_(second - first, x - (float)i, first);
}

/* PD and feed-forward effort, limited by the motor's torque-speed line and the effort limit. */
FN void actuate(Robot *a) {
    float dt = TC(DT), look_ahead = dt * TC(LOOK_AHEAD), share = dt * TC(IMPLICIT_STIFFNESS);
    SHARED_OUT(j, T(JOINTS)) {
        int joint = T(T_JOINT) + j * JOINT_SIZE, explicit_gains = L(joint + 3), table = L(joint + 4);
        float q = S(T(S_JOINT) + j), v = S(T(S_JOINT_VELOCITY) + j);
        float kp = P(P_STIFFNESS, j), kd = P(P_DAMPING, j), ahead = explicit_gains ? 0.0f : look_ahead;
        float spring = fma_(kp, nfma(v, ahead, W(T(W_TARGET) + j) - q), -(kd * v));
        float driven = T(NETWORKS) ? W(T(W_DRIVEN) + j) : D(T(D_FEEDFORWARD) + j);
        float wanted = spring + driven, limit = P(P_EFFORT_LIMIT, j);
        if (table) limit = limit * table_limit(C(table), L(joint + 5), q);
        float stall = P(P_SATURATION_EFFORT, j), speed = v / P(P_MOTOR_VELOCITY_LIMIT, j);
        float most = clamp_(stall * (1.0f - speed), 0.0f, limit);
        float least = clamp_(stall * (-1.0f - speed), -limit, 0.0f);
        float effort = clamp_(wanted, least, most);
        int saturated = (wanted < effort) | (effort < wanted);
        W(T(W_EFFORT) + j) = effort;
        W(T(W_SLOPE) + j) = explicit_gains || saturated ? 0.0f : fma_(kp, share, kd);
    }
}

/* Takes the forces on links from outside off the bias forces. */
FN void add_link_forces(Robot *a) {
    ROLLED for (int f = 0; f < T(LINK_FORCES); f++) {
        int link = L(T(T_FORCE) + 2 * f), in_world = L(T(T_FORCE) + 2 * f + 1);
        float x[LINK_FORCE_SIZE], r[9], at[3], lin[3], torque[3], wrench[6], axis[6];
        d_load(a, T(D_LINK_FORCE) + f * LINK_FORCE_SIZE, LINK_FORCE_SIZE, x);
        if (!(0.0f < x[0])) continue;
        w_load(a, LINK(link), 9, r);
        if (in_world) {
            mul_vec_transposed(a->base_rotation, x + 4, lin);
            mul_vec_transposed(a->base_rotation, x + 7, torque);
        } else {
            mul_vec(r, x + 4, lin);
            mul_vec(r, x + 7, torque);
        }
        mul_vec(r, x + 1, wrench);
        w_load(a, LINK(link) + LINK_POSITION, 3, at);
        add(at, wrench, at);
        cross(at, lin, wrench);
        add(torque, wrench, wrench);
        copy(wrench + 3, lin, 3);
        for (int k = 0; k < 6; k++) a->bias_base[k] = a->bias_base[k] - wrench[k];
        if (!IS_FIRST(a)) continue;
        ROLLED for (int carrier = link; carrier > 0; carrier = L(T(T_JOINT) + (carrier - 1) * JOINT_SIZE)) {
            w_load(a, LINK(carrier) + LINK_AXIS, 6, axis);
            W(T(W_BIAS) + carrier - 1) = W(T(W_BIAS) + carrier - 1) - dot6(axis, wrench);
        }
    }
}

/* The impulses of a tree's joints without constraints, and their velocities; then both in the coordinates
 * in which constraint rows are sparse. */
FN void move_freely(Robot *a, int tree) {
    float dt = TC(DT);
    int rhs = T(W_RHS), joints = T(W_JOINTS);
    OUTWARD(tree, k) {
        int b = TREE_BLOCK(tree, k), block = BLOCK_AT(b);
        for (int place = 0; place < BLOCK; place++) {
            float x = 0.0f, velocity = 0.0f;
            if (place < L(block + 3)) {
                int j = L(block + place);
                velocity = S(T(S_JOINT_VELOCITY) + j);
                float passive = P(P_JOINT_DAMPING, j) * velocity;
                x = (W(T(W_EFFORT) + j) - passive - W(T(W_BIAS) + j)) * dt;
                if (T(HAS_SPRINGS)) {
                    float pull = P(P_SPRING, 2 * j) * (P(P_SPRING, 2 * j + 1) - S(T(S_JOINT) + j));
                    x = fma_(pull, dt, x);
                }
            }
            W(rhs + 3 * b + place) = x;
            W(joints + 3 * b + place) = velocity;
        }
    }
    solve_tree(a, tree, a->y, rhs, joints, T(W_MOVED));
}

/* Kinematics, factors, and the velocity that the robot would have after the step without constraints; the
 * base's in base axes goes to `free_base`, the joints' to W_RHS. What is known of a tree at a time is done
 * together, while its numbers are in the cache. */
FN void find_free_velocity(Robot *a, const float *gravity, float *free_base) {
    float dt = TC(DT), force[3], torque[3], com[3], t[3], impulse[6];
    int rhs = T(W_RHS), moved = T(W_MOVED), stages = T(LINK_FORCES) ? 2 : 1;
    begin_motion(a, gravity);
    s_load(a, T(S_LINEAR), 3, t);
    mul_vec_transposed(a->base_rotation, t, a->velocity_base + 3);
    s_load(a, T(S_ANGULAR), 3, a->velocity_base);
    for (int r = 0; r < 6; r++) a->y[r] = T(FLOATING) ? a->velocity_base[r] : 0.0f;
    if (T(BLOCKS) == 0 && IS_FIRST(a))
        for (int k = 0; k < BLOCK; k++) W(T(W_JOINTS) + k) = W(moved + k) = 0.0f;
    SYNC;
    /* forces on links change the bias forces of joints before the second stage */
    ROLLED for (int stage = 0; stage < stages; stage++) {
        TREES_OF(tree) {
            if (stage == 0) {
                move_tree(a, tree);
                factorise_tree(a, tree);
            }
            if (stage + 1 == stages) move_freely(a, tree);
        }
        SYNC;
        if (stage > 0) continue;
        end_motion(a);
        if (stages == 1) continue;
        add_link_forces(a);
        SYNC;
    }
    factorise_base(a);
    d_load(a, T(D_FORCE), 3, force);
    if (T(NETWORKS)) force[0] = force[0] + W(T(W_UNBOUNDED));
    d_load(a, T(D_TORQUE), 3, torque);
    p_load(a, P_COM, 0, 3, com);
    cross(com, force, t);
    add(torque, t, impulse);
    copy(impulse + 3, force, 3);
    for (int r = 0; r < 6; r++) impulse[r] = (impulse[r] - a->bias_base[r]) * dt;
    half_solve_base(a, impulse, rhs);
    SYNC;
    to_sparse_base(a, a->y);
    for (int r = 0; r < 6; r++) free_base[r] = a->moved[r] = a->y[r] + impulse[r];
    to_dense_base(a, free_base);
    TREES_OF(tree) {
        to_dense_tree(a, tree, free_base, moved, rhs);
        free_links(a, tree);
    }
}

/* Contact bodies of a contact: one on the ground, two of a pair. Returns their number. */
FN int contact_bodies(const Robot *a, int i, int *bodies) {
    int pair = ROW_PAIR(i);
    if (pair < 0) {
        bodies[0] = L(T(T_CONTACT) + ROW_CONTACT(i) * CONTACT_SIZE + 1);
        return 1;
    }
    bodies[0] = L(T(T_PAIR) + pair * PAIR_SIZE + 2);
    bodies[1] = L(T(T_PAIR) + pair * PAIR_SIZE + 3);
    return 2;
}

/* Stores the impulses for the next warm start, and reports the contact forces. */
FN void report_contacts(Robot *a, int substep, int last) {
    float inverse_dt = 1.0f / TC(DT), impulse[3];
    int normal_force = T(R_NORMAL_FORCE) + substep * T(BODIES);
    int list = T(I_PRESSING);
    I(list) = a->num_contacts + a->num_spins;
    ROLLED for (int i = 0; i < a->num_contacts; i++) {
        int bodies[2], num = contact_bodies(a, i, bodies);
        I(list + 1 + i) = ROW_CONTACT(i);
        for (int d = 0; d < 3; d++) impulse[d] = W(ROW(i) + ROW_IMPULSE + d) + 0.0f;
        w_store(a, T(W_PRESSING) + 3 * i, 3, impulse);
        ROLLED for (int k = 0; k < num; k++) {
            R(normal_force + bodies[k]) = fma_(impulse[0], inverse_dt, R(normal_force + bodies[k]));
            TOUCHED(bodies[k]) = 1;
        }
    }
    ROLLED for (int i = 0; i < a->num_spins; i++) {
        int k = a->num_contacts + i;
        I(list + 1 + k) = T(ROWS) + ROW_CONTACT(i);
        for (int d = 0; d < 3; d++) W(T(W_PRESSING) + 3 * k + d) = W(SPIN(i) + SPIN_IMPULSE + d) + 0.0f;
    }
    if (!last) return;
    ROLLED for (int i = 0; i < a->num_contacts; i++) {
        int bodies[2], num = contact_bodies(a, i, bodies);
        float f[3], sum[3], frame[9], axis[3];
        for (int d = 0; d < 3; d++) {
            f[d] = (W(ROW(i) + ROW_IMPULSE + d) + 0.0f) * inverse_dt;
            if (num == 2 || T(HAS_GRID)) {
                w_load(a, ROW(i) + ROW_FRAME + 3 * d, 3, axis);
                mul_vec(a->base_rotation, axis, frame + 3 * d);
            } else {
                copy(frame + 3 * d, C(PLANE + 3 * d), 3);
            }
        }
        ROLLED for (int k = 0; k < num; k++) {
            int at = T(R_BODY_FORCE) + 3 * bodies[k];
            if (k == 1) scale(f, -1.0f, f);
            for (int d = 0; d < 3; d++) sum[d] = R(at + d);
            for (int d = 0; d < 3; d++) add_scaled(sum, frame + 3 * d, f[d], sum);
            for (int d = 0; d < 3; d++) R(at + d) = sum[d];
            W(T(W_DEMANDS) + bodies[k]) = 1.0f;
        }
    }
    ROLLED for (int b = 0; b < T(BLOCKS); b++)
        if (BLOCK_LIMITS(b)) W(T(W_DEMANDS) + T(BODIES) + b) = 1.0f;
    W(T(W_DEMANDS) + T(BODIES) + T(BLOCKS)) = 0.0f < a->violation ? 1.0f : 0.0f;
}

/* Clears the sums to which the contacts add their forces. */
FN void clear_forces(Robot *a, int substep, int last) {
    SHARED_OUT(body, T(BODIES)) {
        R(T(R_NORMAL_FORCE) + substep * T(BODIES) + body) = 0.0f;
        if (substep == 0) TOUCHED(body) = 0;
        for (int d = 0; d < 3 && last; d++) R(T(R_BODY_FORCE) + 3 * body + d) = 0.0f;
    }
    if (last) SHARED_OUT(k, T(BODIES) + T(BLOCKS) + 1) W(T(W_DEMANDS) + k) = 0.0f;
}

/* Takes over the new velocities of a block's joints, and moves their positions with those in the columns
 * `moved`. */
FN void move_block(Robot *a, int b, int joints, int moved) {
    float dt = TC(DT);
    for (int place = 0; place < BLOCK; place++) {
        if (place >= L(BLOCK_AT(b) + 3)) continue;
        int j = L(BLOCK_AT(b) + place), takes_part = NEAR_LIMIT(b, place) | HAS_FRICTION(b, place);
        S(T(S_BOUND) + j) = takes_part ? bound_impulse(a, b, place) + 0.0f : 0.0f;
        float now = W(joints + 3 * b + place) + 0.0f, change = now - S(T(S_JOINT_VELOCITY) + j);
        R(T(R_EFFORT) + j) = nfma(W(T(W_SLOPE) + j), change, W(T(W_EFFORT) + j));
        R(T(R_ACCELERATION) + j) = change / dt;
        S(T(S_JOINT_VELOCITY) + j) = now;
        S(T(S_JOINT) + j) = fma_(W(moved + 3 * b + place) + 0.0f, dt, S(T(S_JOINT) + j));
    }
}

/* Takes over the new velocities, and moves positions with them and the push. */
FN void integrate(Robot *a) {
    float dt = TC(DT);
    int joints = T(W_JOINTS), moved = T(W_MOVED);
    int pushes = 0.0f < a->violation;
    to_dense_base(a, a->y);
    if (pushes) {
        to_dense_base(a, a->moved);
    } else {
        copy(a->moved, a->y, 6);
        moved = joints;
    }
    TREES_OF(tree) {
        to_dense_tree(a, tree, a->y, joints, joints);
        if (pushes) to_dense_tree(a, tree, a->moved, moved, moved);
        OUTWARD(tree, k) move_block(a, TREE_BLOCK(tree, k), joints, moved);
    }
    if (!T(FLOATING) || !IS_FIRST(a)) return;
    float u[6], m[6], linear[3], position[3], q[4], turn[3];
    for (int r = 0; r < 6; r++) {
        u[r] = a->y[r] + 0.0f;
        m[r] = a->moved[r] + 0.0f;
    }
    mul_vec(a->base_rotation, u + 3, linear);
    for (int d = 0; d < 3; d++) {
        S(T(S_ANGULAR) + d) = u[d];
        S(T(S_LINEAR) + d) = linear[d] + 0.0f;
    }
    mul_vec(a->base_rotation, m + 3, linear);
    s_load(a, T(S_POSITION), 3, position);
    s_load(a, T(S_ROTATION), 4, q);
    for (int d = 0; d < 3; d++) {
        S(T(S_POSITION) + d) = fma_(linear[d] + 0.0f, dt, position[d]);
        turn[d] = m[d] * dt;
    }
    integrate_quat(q, turn);
    for (int k = 0; k < 4; k++) S(T(S_ROTATION) + k) = q[k];
}

/* Positions and velocities of the sites at the end of the control step. */
FN void report_sites(Robot *a) {
    float q[4], rotation[9], base[6], t[3], at[3], v[3], r[9], site[3], position[3], motion[6];
    s_load(a, T(S_ROTATION), 4, q);
    quat_to_mat(q, rotation);
    s_load(a, T(S_ANGULAR), 3, base);
    s_load(a, T(S_LINEAR), 3, t);
    mul_vec_transposed(rotation, t, base + 3);
    forward_kinematics(a, base);
    s_load(a, T(S_POSITION), 3, position);
    SHARED_OUT(i, T(SITES)) {
        int link = LINK(L(T(T_SITE) + i));
        w_load(a, link, 9, r);
        w_load(a, link + LINK_POSITION, 3, at);
        w_load(a, link + LINK_VELOCITY, 6, motion);
        p_load(a, P_SITE_POSITION, 3 * i, 3, site);
        mul_vec(r, site, t);
        add(at, t, at);
        cross(motion, at, t);
        add(motion + 3, t, v);
        mul_vec(rotation, at, t);
        for (int d = 0; d < 3; d++) R(T(R_SITE_POSITION) + 3 * i + d) = position[d] + t[d];
        mul_vec(rotation, v, t);
        for (int d = 0; d < 3; d++) R(T(R_SITE_VELOCITY) + 3 * i + d) = t[d];
    }
}

/* One physics step. */
FN void physics_step(Robot *a, int substep) {
    float q[4], gravity[3], free_base[6];
    int last = substep + 1 == T(DECIMATION);
    s_load(a, T(S_ROTATION), 4, q);
    quat_to_mat(q, a->base_rotation);
    mul_vec_transposed(a->base_rotation, C(GRAVITY), gravity);
    a->violation = 0.0f;
    clear_forces(a, substep, last);
    actuate(a);
    find_free_velocity(a, gravity, free_base);
    SYNC;
    build_ground_contacts(a, free_base);
    build_pairs(a);
    SYNC;
    copy(a->y, a->moved, 6);
    SHARED_OUT(k, BLOCK * T(BLOCKS)) W(T(W_JOINTS) + k) = W(T(W_MOVED) + k);
    SHARED_OUT(b, T(BLOCKS)) build_joint_bounds(a, b);
    share_violation(a);
    solve(a);
    if (IS_FIRST(a)) report_contacts(a, substep, last);
    integrate(a);
    SYNC;
}

/* Takes over the impulses of the state's list, which has room for `capacity` of them. */
FN void take_pressing(Robot *a, int capacity) {
    int count = (int)a->row[T(S_PRESSING)], list = T(I_PRESSING);
    count = count < capacity ? count : capacity;
    if (IS_FIRST(a)) I(list) = count;
    SHARED_OUT(i, count) {
        const float *from = a->row + T(S_PRESSING) + 1 + LISTED_SIZE * i;
        I(list + 1 + i) = (int)from[0];
        for (int d = 0; d < 3; d++) W(T(W_PRESSING) + 3 * i + d) = from[1 + d];
    }
}

/* Writes the impulses that are not zero to the state's list, as many as it has room for, and their
 * number. */
FN void list_pressing(Robot *a, int capacity) {
    int count = 0, list = T(I_PRESSING);
    ROLLED for (int i = 0; i < I(list); i++) {
        float impulse[3];
        w_load(a, T(W_PRESSING) + 3 * i, 3, impulse);
        if (impulse[0] == 0.0f && impulse[1] == 0.0f && impulse[2] == 0.0f) continue;
        if (count < capacity) {
            float *to = a->row + T(S_PRESSING) + 1 + LISTED_SIZE * count;
            to[0] = (float)I(list + 1 + i);
            copy(to + 1, impulse, 3);
        }
        count++;
    }
    a->row[T(S_PRESSING)] = (float)count;
}

/* The physics steps `first` to `end` of a control step, from the row of the state and back. */
FN void control_step(Robot *a, int first, int end, int capacity) {
    SHARED_OUT(k, T(S_PRESSING)) S(k) = a->row[k];
    take_pressing(a, capacity);
    SYNC;
    ROLLED for (int substep = first; substep < end; substep++) {
        select_targets(a, substep);
        if (T(NETWORKS)) drive_by_networks(a, substep);
        physics_step(a, substep);
    }
    SHARED_OUT(k, T(S_PRESSING)) a->row[k] = S(k);
    if (IS_FIRST(a)) list_pressing(a, capacity);
    if (end == T(DECIMATION)) report_sites(a);
}
#endif
