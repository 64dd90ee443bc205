/* Kinematics, composite inertias and bias forces: crates/dynamics/src/kinematics.rs. */
#ifndef POLYPOD_KINEMATICS_H
#define POLYPOD_KINEMATICS_H
#include "factor.h"

/* A turn about a coordinate axis mixes the two other columns. */
FN void turned_about(float *r, float *axis, float sign, float angle, int x, int y, int z) {
    float s, c;
    sin_cos(angle, &s, &c);
    s = s * sign;
    set3(axis, r[x] * sign, r[3 + x] * sign, r[6 + x] * sign);
    for (int i = 0; i < 9; i += 3) {
        float b = r[i + y], d = r[i + z];
        r[i + y] = fma_(c, b, s * d);
        r[i + z] = fma_(c, d, -(s * b));
    }
}

/* Turns r about an axis of its own; the axis in the outer frame goes to `axis`. */
FN void turned(const Robot *a, int j, float angle, float *r, float *axis) {
    const float *u = C(T(C_AXIS) + j * AXIS_SIZE);
    switch (L(T(T_JOINT) + j * JOINT_SIZE + 2)) {
    case 0: turned_about(r, axis, u[3], angle, 0, 1, 2); return;
    case 1: turned_about(r, axis, u[3], angle, 1, 2, 0); return;
    case 2: turned_about(r, axis, u[3], angle, 2, 0, 1); return;
    default: break;
    }
    float s, c;
    sin_cos(angle, &s, &c);
    float versine = 1.0f - c;
    float vx = u[0] * versine, vy = u[1] * versine, vz = u[2] * versine;
    float sx = u[0] * s, sy = u[1] * s, sz = u[2] * s;
    float turn[9] = {fma_(vx, u[0], c), fma_(vx, u[1], -sz), fma_(vx, u[2], sy),
                     fma_(vy, u[0], sz), fma_(vy, u[1], c), fma_(vy, u[2], -sx),
                     fma_(vz, u[0], -sy), fma_(vz, u[1], sx), fma_(vz, u[2], c)};
    mul_vec(r, u, axis);
    for (int i = 0; i < 9; i += 3) {
        float x = r[i], y = r[i + 1], z = r[i + 2];
        for (int j1 = 0; j1 < 3; j1++) r[i + j1] = fma_(x, turn[j1], fma_(y, turn[3 + j1], z * turn[6 + j1]));
    }
}

FN void place_base(Robot *a, const float *velocity) {
    for (int i = 0; i < 9; i++) W(LINK(0) + i) = i % 4 == 0 ? 1.0f : 0.0f;
    for (int i = 0; i < 3; i++) W(LINK(0) + LINK_POSITION + i) = 0.0f;
    w_store(a, LINK(0) + LINK_VELOCITY, 6, velocity);
    for (int i = 0; i < 6; i++) W(LINK(0) + LINK_FREE + i) = 0.0f;
}

/* Position, axis and velocity of the link that a joint moves. `r`, `x` and `v` are its parent's before
 * and its own after. */
FN void place_link(Robot *a, int j, float *r, float *x, float *v, float *axis) {
    int parent = L(T(T_JOINT) + j * JOINT_SIZE), to = LINK(j + 1);
    float offset[3], t[3], position = S(T(S_JOINT) + j), velocity = S(T(S_JOINT_VELOCITY) + j);
    p_load(a, P_OFFSET, 3 * j, 3, offset);
    if (parent == 0) {
        copy(x, offset, 3);
    } else {
        mul_vec(r, offset, t);
        add(x, t, x);
    }
    if (L(T(T_JOINT) + j * JOINT_SIZE + 1)) {
        mul_vec(r, C(T(C_AXIS) + j * AXIS_SIZE), axis + 3);
        set3(axis, 0.0f, 0.0f, 0.0f);
        add_scaled(x, axis + 3, position, x);
    } else {
        turned(a, j, position, r, axis);
        cross(x, axis, axis + 3);
    }
    for (int i = 0; i < 6; i++) v[i] = fma_(axis[i], velocity, v[i]);
    w_store(a, to, 9, r);
    w_store(a, to + LINK_POSITION, 3, x);
    w_store(a, to + LINK_VELOCITY, 6, v);
    w_store(a, to + LINK_AXIS, 6, axis);
}

FN void load_link(const Robot *a, int link, float *r, float *x, float *v) {
    w_load(a, LINK(link), 9, r);
    w_load(a, LINK(link) + LINK_POSITION, 3, x);
    w_load(a, LINK(link) + LINK_VELOCITY, 6, v);
}

FN void forward_kinematics(Robot *a, const float *base_velocity) {
    if (IS_FIRST(a)) place_base(a, base_velocity);
    SYNC;
    TREES_OF(tree) OUTWARD(tree, k) {
        int block = BLOCK_AT(TREE_BLOCK(tree, k));
        ROLLED for (int place = 0; place < L(block + 3); place++) {
            int j = L(block + place);
            float r[9], x[3], v[6], axis[6];
            load_link(a, L(T(T_JOINT) + j * JOINT_SIZE), r, x, v);
            place_link(a, j, r, x, v, axis);
        }
    }
    SYNC;
}

/* Sets the free velocities of a tree's links to those that the joint velocities in W_RHS give them. */
FN void free_links(Robot *a, int tree) {
    OUTWARD(tree, k) {
        int b = TREE_BLOCK(tree, k), block = BLOCK_AT(b);
        float free[6];
        w_load(a, LINK(L(T(T_JOINT) + L(block) * JOINT_SIZE)) + LINK_FREE, 6, free);
        for (int place = 0; place < BLOCK; place++) {
            if (place >= L(block + 3)) continue;
            int to = LINK(L(block + place) + 1);
            float velocity = W(T(W_RHS) + 3 * b + place);
            for (int i = 0; i < 6; i++) free[i] = fma_(W(to + LINK_AXIS + i), velocity, free[i]);
            w_store(a, to + LINK_FREE, 6, free);
        }
    }
}

/* Inertia about the base's origin, and the force that motion and gravity ask for, by Newton's and
 * Euler's equations about the centre of mass. */
FN void link_dynamics(Robot *a, int at, float mass, const float *com, const float *inertia, const float *velocity,
                      const float *acceleration) {
    float spatial[10], of_com[3], lin[3], ang[3], t[3];
    spatial_inertia(mass, com, inertia, spatial);
    cross_add(velocity, com, velocity + 3, of_com);
    cross_add(acceleration, com, acceleration + 3, t);
    cross_add(velocity, of_com, t, lin);
    scale(lin, mass, lin);
    mul_sym(inertia, acceleration, ang);
    mul_sym(inertia, velocity, t);
    cross_add(velocity, t, ang, ang);
    cross_add(com, lin, ang, ang);
    w_store(a, at, 6, acceleration);
    w_store(a, at + DYNAMICS_INERTIA, 10, spatial);
    w_store(a, at + DYNAMICS_FORCE, 3, ang);
    w_store(a, at + DYNAMICS_FORCE + 3, 3, lin);
}

#define DYNAMICS(link) (T(W_DYNAMICS) + (link) * DYNAMICS_SIZE)

/* The base's part of the equations of motion before the trees'. `gravity` is in base axes. */
FN void begin_motion(Robot *a, const float *gravity) {
    float velocity[6] = {0}, acceleration[6] = {0}, com[3], inertia[6];
    if (!IS_FIRST(a)) return;
    s_load(a, T(S_ANGULAR), 3, velocity);
    place_base(a, velocity);
    scale(gravity, -1.0f, acceleration + 3);
    p_load(a, P_COM, 0, 3, com);
    p_load(a, P_INERTIA, 0, 6, inertia);
    link_dynamics(a, DYNAMICS(0), P(P_MASS, 0), com, inertia, velocity, acceleration);
}

/* Positions, axes and velocities of a tree's links, their bias forces and their part of the mass matrix:
 * from the base to the leaves and back. */
FN void move_tree(Robot *a, int tree) {
    OUTWARD(tree, k) {
        int block = BLOCK_AT(TREE_BLOCK(tree, k)), len = L(block + 3);
        int parent = L(T(T_JOINT) + L(block) * JOINT_SIZE);
        float velocity[6], acceleration[6], com[3], inertia[6], r[9], x[3];
        load_link(a, parent, r, x, velocity);
        w_load(a, DYNAMICS(parent), 6, acceleration);
        /* the joints of a block carry each other */
        ROLLED for (int place = 0; place < len; place++) {
            int j = L(block + place);
            float axis[6], relative[6], product[6], local[6], v = S(T(S_JOINT_VELOCITY) + j);
            place_link(a, j, r, x, velocity, axis);
            for (int i = 0; i < 6; i++) relative[i] = axis[i] * v;
            cross_motion(velocity, relative, product);
            for (int i = 0; i < 6; i++) acceleration[i] = acceleration[i] + product[i];
            p_load(a, P_COM, 3 * (j + 1), 3, local);
            mul_vec(r, local, com);
            add(x, com, com);
            p_load(a, P_INERTIA, 6 * (j + 1), 6, local);
            rotate_sym(r, local, inertia);
            link_dynamics(a, DYNAMICS(j + 1), P(P_MASS, j + 1), com, inertia, velocity, acceleration);
        }
    }
    INWARD(tree, k) {
        int b = TREE_BLOCK(tree, k), block = BLOCK_AT(b), parent = L(T(T_JOINT) + L(block) * JOINT_SIZE);
        float carried[TREE_SIZE];
        for (int i = 0; i < 16; i++) carried[i] = 0.0f;
        ROLLED for (int place = L(block + 3) - 1, last = place; place >= 0; place--) {
            int j = L(block + place), own = DYNAMICS(j + 1) + DYNAMICS_INERTIA;
            float axis[6], composite[16];
            w_load(a, own, 16, composite);
            for (int i = 0; i < 16; i++) carried[i] = place < last ? composite[i] + carried[i] : composite[i];
            w_load(a, LINK(j + 1) + LINK_AXIS, 6, axis);
            set_joint(a, b, place, j, carried, axis);
            W(T(W_BIAS) + j) = dot6(axis, carried + 10);
        }
        /* the base's first block is the last one of its tree */
        if (parent == 0)
            w_store(a, T(W_TREE) + TREE_SIZE * tree, TREE_SIZE, carried);
        else
            for (int i = 0, at = DYNAMICS(parent) + DYNAMICS_INERTIA; i < 16; i++) W(at + i) = W(at + i) + carried[i];
        set_empty_places(a, b);
    }
}

/* The base's part after the trees'. */
FN void end_motion(Robot *a) {
    float whole[TREE_SIZE];
    w_load(a, DYNAMICS(0) + DYNAMICS_INERTIA, 16, whole);
    ROLLED for (int tree = T(TREES) - 1; tree >= 0; tree--)
        for (int i = 0; i < 16; i++) whole[i] = whole[i] + W(T(W_TREE) + TREE_SIZE * tree + i);
    copy(a->bias_base, whole + 10, 6);
    set_base(a, whole);
    a->compliance = 1.0f / whole[0];
}
#endif
