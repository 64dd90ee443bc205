/* Position limits, velocity limits and dry friction of joints: crates/dynamics/src/joint_bounds.rs. */
#ifndef POLYPOD_BOUNDS_H
#define POLYPOD_BOUNDS_H
#include "ground.h"

enum BoundNumber { DIAGONAL, INVERSE, LOWEST, HIGHEST, LIMIT_IMPULSE, PUSH_IMPULSE, FRICTION_IMPULSE, MAX_FRICTION };
#define BOUND_ROW(b, i) (BOUND(b) + BOUND_JOINT + (i) * BOUND_JOINT_SIZE)
#define BLOCK_LIMITS(b) I(BOUND_INTEGER(b))
#define BLOCK_ACTIVE(b) I(BOUND_INTEGER(b) + 1)
#define NEAR_LIMIT(b, i) I(BOUND_INTEGER(b) + 2 + 2 * (i))
#define HAS_FRICTION(b, i) I(BOUND_INTEGER(b) + 3 + 2 * (i))

/* Whether a joint is near a position limit or its velocity limit. */
FN int near_limits(const Robot *a, int j, float free) {
    float q = S(T(S_JOINT) + j), fastest = P(P_VELOCITY_LIMIT, j), dt = TC(DT);
    float margin = clamp_(fastest * dt, TC(LIMIT_REACH), TC(MAX_LIMIT_REACH));
    float speed = max_(fabsf(free), fabsf(S(T(S_JOINT_VELOCITY) + j)));
    float reach = fma_(speed, dt + dt, margin);
    int position = (q - reach < P(P_LOWER, j)) | (P(P_UPPER, j) < q + reach);
    return position | (fastest * TC(VELOCITY_LIMIT_SHARE) < speed);
}

/* Sets the targets and the warm start of a joint's limits. */
FN void set_limits(Robot *a, int j, int row, int near, float inverse_dt) {
    W(row + LOWEST) = NO_TARGET;
    W(row + HIGHEST) = -NO_TARGET;
    W(row + LIMIT_IMPULSE) = 0.0f;
    W(row + PUSH_IMPULSE) = 0.0f;
    if (!near) return;
    float q = S(T(S_JOINT) + j), fastest = P(P_VELOCITY_LIMIT, j);
    float low = q - P(P_LOWER, j), high = P(P_UPPER, j) - q;
    float up = push_speed(a, -low, TC(LIMIT_SLOP), inverse_dt), down = push_speed(a, -high, TC(LIMIT_SLOP), inverse_dt);
    float lowest = max_(low < 0.0f ? up : -(low * inverse_dt), -fastest);
    float highest = min_(high < 0.0f ? -down : high * inverse_dt, fastest);
    a->violation = max_(a->violation, max_(up, down));
    W(row + LOWEST) = lowest;
    W(row + HIGHEST) = highest;
    W(row + LIMIT_IMPULSE) = S(T(S_BOUND) + j) - W(row + FRICTION_IMPULSE);
}

/* Builds the rows of a block if a joint is near a limit or has Coulomb friction. The joints' velocities
 * without constraints are in W_RHS. */
FN void build_joint_bounds(Robot *a, int b) {
    float dt = TC(DT), inverse_dt = 1.0f / dt;
    int block = BLOCK_AT(b), len = L(block + 3), limits = 0, active = 0, bound = BOUND(b);
    for (int place = 0; place < BLOCK; place++) {
        int near = 0, friction = 0;
        if (place < len) {
            int j = L(block + place);
            near = near_limits(a, j, W(T(W_RHS) + 3 * b + place));
            friction = 0.0f < P(P_JOINT_FRICTION, j);
        }
        NEAR_LIMIT(b, place) = near;
        HAS_FRICTION(b, place) = friction;
        limits |= near;
        active |= near | friction;
    }
    BLOCK_LIMITS(b) = limits;
    BLOCK_ACTIVE(b) = active;
    if (!active) return;
    I(BOUND_INTEGER(b) + 8) = PATH_PARTS(BOUND_PATH(b));
    I(BOUND_INTEGER(b) + 9) = PATH_FIRST(BOUND_PATH(b));
    for (int place = 0; place < BLOCK; place++) {
        int row = BOUND_ROW(b, place);
        if (place < len) {
            int j = L(block + place);
            float most = P(P_JOINT_FRICTION, j) * dt;
            W(row + MAX_FRICTION) = most;
            /* friction takes as much of the stored impulse as it can */
            W(row + FRICTION_IMPULSE) = clamp_(S(T(S_BOUND) + j), -most, most);
            if (limits) set_limits(a, j, row, NEAR_LIMIT(b, place), inverse_dt);
        } else {
            for (int k = 0; k < BOUND_JOINT_SIZE; k++) W(row + k) = 0.0f;
            W(row + LOWEST) = NO_TARGET;
            W(row + HIGHEST) = -NO_TARGET;
        }
    }
    float base[18], own[9], product[6], inverse[3];
    half_solve_units(a, base, own, BOUND_PARTS(b), BOUND_PATH(b));
    products(a, base, own, BOUND_PARTS(b), BOUND_PATH(b), 1, product);
    w_store(a, bound, 18, base);
    w_store(a, bound + ROW_OWN, 9, own);
    for (int i = 0; i < BLOCK; i++) {
        inverse[i] = 1.0f / product[i];
        W(BOUND_ROW(b, i) + DIAGONAL) = product[i];
        W(BOUND_ROW(b, i) + INVERSE) = inverse[i];
    }
    w_store(a, bound + ROW_COUPLING, 3, product + 3);
    W(bound + BOUND_FRICTION) = product[3] * inverse[1];
    W(bound + BOUND_FRICTION + 1) = product[4] * inverse[2];
    W(bound + BOUND_FRICTION + 2) = product[5] * inverse[2];
}

/* Impulse of the limit and of dry friction together. */
FN float bound_impulse(const Robot *a, int b, int i) {
    int row = BOUND_ROW(b, i);
    return NEAR_LIMIT(b, i) ? W(row + LIMIT_IMPULSE) + W(row + FRICTION_IMPULSE) : W(row + FRICTION_IMPULSE);
}
#endif
