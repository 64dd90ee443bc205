/* The contact solver: warm-started Gauss-Seidel sweeps over contacts and joint bounds,
 * crates/dynamics/src/solver/. A single robot needs no masks: a sweep is made or it is not.
 *
 * Rows follow each other, so that one thread of a robot solves them while the others wait. What it reads of
 * a contact's rows is in registers while it works on them. */
#ifndef POLYPOD_SOLVER_H
#define POLYPOD_SOLVER_H
#include "bounds.h"

#define NUM_VELOCITIES (BLOCK * (T(BLOCKS) > 0 ? T(BLOCKS) : 1))

/* Applies the impulses of the last physics step, all scaled by one share in [0, 1]. */
FN void warm_start(Robot *a) {
    int moved = T(W_MOVED), joints = T(W_JOINTS), numbers = NUM_VELOCITIES;
    float targets = 0.0f, energy = (float)1e-20, impulse[3];
    Rows z;
    for (int r = 0; r < 6; r++) a->moved[r] = 0.0f;
    ROLLED for (int k = 0; k < numbers; k++) W(moved + k) = 0.0f;
    ROLLED for (int i = 0; i < a->num_contacts; i++) {
        int row = ROW(i);
        w_load(a, row + ROW_IMPULSE, 3, impulse);
        targets = fma_(W(row + ROW_TARGET), impulse[0], targets);
        energy = fma_(W(row + ROW_SOFTNESS) * impulse[0], impulse[0], energy);
        load_rows(a, row, &z);
        apply_rows(a, &z, ROW_PARTS(i), path_of_row(a, i), 0, impulse, a->moved, moved);
    }
    ROLLED for (int i = 0; i < a->num_spins; i++) {
        w_load(a, SPIN(i) + SPIN_IMPULSE, 3, impulse);
        if (T(FRICTION) == 2) {
            load_rows(a, SPIN(i), &z);
            apply_rows(a, &z, SPIN_PARTS(i), path_of_row(a, i), 0, impulse, a->moved, moved);
        } else
            apply_first(a, SPIN(i), SPIN_PARTS(i), path_of_row(a, i), impulse[0], a->moved, moved);
    }
    ROLLED for (int b = 0; b < T(BLOCKS); b++) {
        if (!BLOCK_ACTIVE(b)) continue;
        for (int i = 0; i < BLOCK; i++) impulse[i] = bound_impulse(a, b, i);
        load_rows(a, BOUND(b), &z);
        apply_rows(a, &z, BOUND_PARTS(b), path_of_bound(a, b), 1, impulse, a->moved, moved);
        if (!BLOCK_LIMITS(b)) continue;
        for (int i = 0; i < BLOCK; i++) {
            int row = BOUND_ROW(b, i);
            float limit = W(row + LIMIT_IMPULSE);
            float target = 0.0f < limit ? min_(W(row + LOWEST), 0.0f) : max_(W(row + HIGHEST), 0.0f);
            targets = fma_(target, limit, targets);
        }
    }
    float gain = targets;
    ROLLED for (int k = 0; k < numbers; k++) {
        float change = W(moved + k);
        gain = nfma(change, W(joints + k), gain);
        energy = fma_(change, change, energy);
    }
    for (int r = 0; r < 6; r++) {
        gain = nfma(a->moved[r], a->y[r], gain);
        energy = fma_(a->moved[r], a->moved[r], energy);
    }
    float share = clamp_(gain / energy, 0.0f, 1.0f);
    ROLLED for (int k = 0; k < numbers; k++) W(joints + k) = fma_(share, W(moved + k), W(joints + k));
    for (int r = 0; r < 6; r++) a->y[r] = fma_(share, a->moved[r], a->y[r]);
    ROLLED for (int i = 0; i < a->num_contacts; i++)
        for (int d = 0; d < 3; d++) W(ROW(i) + ROW_IMPULSE + d) = W(ROW(i) + ROW_IMPULSE + d) * share;
    ROLLED for (int i = 0; i < a->num_spins; i++)
        for (int d = 0; d < 3; d++) W(SPIN(i) + SPIN_IMPULSE + d) = W(SPIN(i) + SPIN_IMPULSE + d) * share;
    ROLLED for (int b = 0; b < T(BLOCKS); b++) {
        if (!BLOCK_ACTIVE(b)) continue;
        for (int i = 0; i < BLOCK; i++) {
            int row = BOUND_ROW(b, i);
            W(row + FRICTION_IMPULSE) = W(row + FRICTION_IMPULSE) * share;
            if (BLOCK_LIMITS(b)) W(row + LIMIT_IMPULSE) = W(row + LIMIT_IMPULSE) * share;
        }
    }
}

/* Impulse that brings a velocity into its bounds; with `impulse` the velocity is w. */
FN float bounding(const Robot *a, int row, float w, float impulse, float lowest, float highest) {
    float without = nfma(W(row + DIAGONAL), impulse, w);
    return (clamp_(without, lowest, highest) - without) * W(row + INVERSE);
}

/* Impulse of the limit that brings the velocity w into its bounds; `old` is the one so far. */
FN float limiting(const Robot *a, int row, int near, float w, float old) {
    return near ? bounding(a, row, w, old, min_(W(row + LOWEST), 0.0f), max_(W(row + HIGHEST), 0.0f)) : old;
}

/* Impulse of the motion that pushes joints back. */
FN float pushing_back(const Robot *a, int row, int near, float w, float old) {
    return near ? bounding(a, row, w, old, W(row + LOWEST), W(row + HIGHEST)) : old;
}

/* Adds to the velocities of later rows what an impulse on row i changes in them. */
FN void pass_change(const float *coupling, int i, float change, float *w) {
    if (i == 0) {
        w[1] = fma_(coupling[0], change, w[1]);
        w[2] = fma_(coupling[1], change, w[2]);
    } else if (i == 1) {
        w[2] = fma_(coupling[2], change, w[2]);
    }
}

/* One sweep over the joints' limits and dry friction. */
FN void sweep_bounds(Robot *a) {
    ROLLED for (int b = 0; b < T(BLOCKS); b++) {
        if (!BLOCK_ACTIVE(b)) continue;
        int bound = BOUND(b), limits = BLOCK_LIMITS(b);
        Path path = path_of_bound(a, b);
        Rows z;
        load_rows(a, bound, &z);
        float w[3], stopping[3], change[3], pass[3], coupling[3], friction[3], limit[3];
        velocities(a, &z, BOUND_PARTS(b), path, 1, a->y, T(W_JOINTS), w);
        w_load(a, bound + BOUND_FRICTION, 3, pass);
        w_load(a, bound + ROW_COUPLING, 3, coupling);
        for (int i = 0; i < 3; i++)
            stopping[i] = nfma(w[i], W(BOUND_ROW(b, i) + INVERSE), W(BOUND_ROW(b, i) + FRICTION_IMPULSE));
        for (int i = 0; i < 3; i++) {
            int row = BOUND_ROW(b, i);
            float old = W(row + FRICTION_IMPULSE), most = W(row + MAX_FRICTION);
            friction[i] = clamp_(stopping[i], -most, most);
            change[i] = friction[i] - old;
            if (limits) {
                if (NEAR_LIMIT(b, i)) {
                    float impulse = W(row + LIMIT_IMPULSE);
                    limit[i] = limiting(a, row, 1, fma_(W(row + DIAGONAL), change[i], w[i]), impulse);
                    change[i] = change[i] + (limit[i] - impulse);
                }
                pass_change(coupling, i, change[i], w);
            }
            if (i == 0) {
                stopping[1] = nfma(change[0], pass[0], stopping[1]);
                stopping[2] = nfma(change[0], pass[1], stopping[2]);
            } else if (i == 1) {
                stopping[2] = nfma(change[1], pass[2], stopping[2]);
            }
        }
        apply_rows(a, &z, BOUND_PARTS(b), path, 1, change, a->y, T(W_JOINTS));
        for (int i = 0; i < 3; i++) {
            W(BOUND_ROW(b, i) + FRICTION_IMPULSE) = friction[i];
            if (limits && NEAR_LIMIT(b, i)) W(BOUND_ROW(b, i) + LIMIT_IMPULSE) = limit[i];
        }
    }
}

/* One sweep over joint limits alone. Returns the largest change of a velocity. */
FN float sweep_limits(Robot *a, int pushing, float *y, int joints) {
    float most = 0.0f;
    ROLLED for (int b = 0; b < T(BLOCKS); b++) {
        if (!BLOCK_LIMITS(b)) continue;
        int of = pushing ? PUSH_IMPULSE : LIMIT_IMPULSE;
        Path path = path_of_bound(a, b);
        Rows z;
        load_rows(a, BOUND(b), &z);
        float w[3], change[3], coupling[3], limit[3];
        velocities(a, &z, BOUND_PARTS(b), path, 1, y, joints, w);
        w_load(a, BOUND(b) + ROW_COUPLING, 3, coupling);
        for (int i = 0; i < 3; i++) {
            int row = BOUND_ROW(b, i), near = NEAR_LIMIT(b, i);
            float old = W(row + of);
            limit[i] = pushing ? pushing_back(a, row, near, w[i], old) : limiting(a, row, near, w[i], old);
            change[i] = limit[i] - old;
            most = max_(most, fabsf(change[i] * W(row + DIAGONAL)));
            pass_change(coupling, i, change[i], w);
        }
        apply_rows(a, &z, BOUND_PARTS(b), path, 1, change, y, joints);
            for (int i = 0; i < 3; i++) W(BOUND_ROW(b, i) + of) = limit[i];
    }
    return most;
}

/* Sweeps over joint limits alone until none changes a velocity. */
FN void settle_limits(Robot *a, int pushing, float *y, int joints) {
    ROLLED for (int sweep = 0; sweep < T(LIMIT_SWEEPS); sweep++)
        if (!(TC(LIMIT_TOLERANCE) < sweep_limits(a, pushing, y, joints))) break;
}

/* Static and dynamic coefficient of a contact. */
FN void sliding_friction(const Robot *a, int contact, float *friction) {
    friction[0] = P(P_STATIC_FRICTION, 0);
    friction[1] = P(P_DYNAMIC_FRICTION, 0);
    if (!T(HAS_SURFACES) || contact >= T(CONTACTS)) return;
    float factor = P(P_CONTACT_FRICTION, 3 * contact);
    friction[0] = friction[0] * factor;
    friction[1] = friction[1] * factor;
}

/* Impulses along the tangents of a point that slides: against its velocity, in a disc. */
FN void sliding(float mass, float w1, float w2, float i1, float i2, float bound, float *s) {
    float s1 = nfma(w1, mass, i1), s2 = nfma(w2, mass, i2);
    float square = fma_(s1, s1, fma_(s2, s2, (float)1e-20));
    float shrink = min_(bound / square * sqrtf(square), 1.0f);
    s[0] = s1 * shrink;
    s[1] = s2 * shrink;
}

/* One regular sweep over the contacts: normals and friction. */
FN void sweep_contacts(Robot *a) {
    ROLLED for (int i = 0; i < a->num_contacts; i++) {
        int row = ROW(i);
        Path path = path_of_row(a, i);
        Rows z;
        load_rows(a, row, &z);
        float friction[2], old[3], w[3], inverse[3], pass[3], s[2];
        sliding_friction(a, ROW_CONTACT(i), friction);
        w_load(a, row + ROW_IMPULSE, 3, old);
        w_load(a, row + ROW_INVERSE, 3, inverse);
        w_load(a, row + ROW_STICKING, 3, pass);
        float c1 = W(row + ROW_COUPLING), c2 = W(row + ROW_COUPLING + 1), slide = W(row + ROW_SLIDE);
        float at_rest = nfma(fma_(W(row + ROW_SOFTNESS), old[0], -W(row + ROW_TARGET)), inverse[0], old[0]);
        velocities(a, &z, ROW_PARTS(i), path, 0, a->y, T(W_JOINTS), w);
        float normal = max_(nfma(w[0], inverse[0], at_rest), 0.0f);
        float dn = normal - old[0];
        /* the point sticks if the impulse that stops it is inside the disc of the static coefficient */
        float t1 = nfma(dn, pass[0], nfma(w[1], inverse[1], old[1]));
        float t2 = nfma(dn, pass[1], fma_(w[1], pass[2], nfma(w[2], inverse[2], old[2])));
        float hold = friction[0] * normal;
        int presses = 0.0f < normal, slides = hold * hold < fma_(t1, t1, t2 * t2);
        float w1 = fma_(c1, dn, w[1]), w2 = fma_(c2, dn, w[2]);
        sliding(slide, w1, w2, old[1], old[2], friction[1] * normal, s);
        float now[3] = {normal, presses ? (slides ? s[0] : t1) : 0.0f, presses ? (slides ? s[1] : t2) : 0.0f};
        float change[3] = {dn, now[1] - old[1], now[2] - old[2]};
        apply_rows(a, &z, ROW_PARTS(i), path, 0, change, a->y, T(W_JOINTS));
        w_store(a, row + ROW_IMPULSE, 3, now);
    }
}

/* One sweep over torsional and rolling friction. */
FN void sweep_spins(Robot *a) {
    ROLLED for (int i = 0; i < a->num_spins; i++) {
        int spin = SPIN(i), contact = ROW_CONTACT(i);
        Rows z;
        Path path = path_of_row(a, i);
        float torsional = P(P_TORSIONAL_FRICTION, 0), rolling = P(P_ROLLING_FRICTION, 0);
        if (T(HAS_SURFACES)) {
            torsional = max_(torsional, P(P_CONTACT_FRICTION, 3 * contact + 1));
            rolling = max_(rolling, P(P_CONTACT_FRICTION, 3 * contact + 2));
        }
        float old[3], now[3], inverse[3], coupling[3], change[3], normal = W(ROW(i) + ROW_IMPULSE);
        float bound = torsional * normal;
        w_load(a, spin + SPIN_IMPULSE, 3, old);
        w_load(a, spin + ROW_INVERSE, 3, inverse);
        copy(now, old, 3);
        if (T(FRICTION) == 2) {
            float w[3], s[2];
            w_load(a, spin + ROW_COUPLING, 3, coupling);
            load_rows(a, spin, &z);
            velocities(a, &z, SPIN_PARTS(i), path, 0, a->y, T(W_JOINTS), w);
            now[0] = clamp_(nfma(w[0], inverse[0], old[0]), -bound, bound);
            float turned = now[0] - old[0];
            float w1 = fma_(coupling[0], turned, w[1]), w2 = fma_(coupling[1], turned, w[2]);
            float t1 = nfma(w1, inverse[1], old[1]);
            float t2 = nfma(fma_(coupling[2], t1 - old[1], w2), inverse[2], old[2]);
            float disc = rolling * normal;
            int rolls = disc * disc < fma_(t1, t1, t2 * t2);
            sliding(W(spin + SPIN_ROLL), w1, w2, old[1], old[2], disc, s);
            now[1] = rolls ? s[0] : t1;
            now[2] = rolls ? s[1] : t2;
        } else {
            float w = first_velocity(a, spin, SPIN_PARTS(i), path, a->y, T(W_JOINTS));
            now[0] = clamp_(nfma(w, inverse[0], old[0]), -bound, bound);
        }
        sub(now, old, change);
        if (T(FRICTION) == 2)
            apply_rows(a, &z, SPIN_PARTS(i), path, 0, change, a->y, T(W_JOINTS));
        else
            apply_first(a, spin, SPIN_PARTS(i), path, change[0], a->y, T(W_JOINTS));
        w_store(a, spin + SPIN_IMPULSE, 3, now);
    }
}

/* Whether another sweep would change the velocity of a contact by more than the settings allow. */
FN int unsettled(Robot *a) {
    float beyond = 0.0f;
    ROLLED for (int i = 0; i < a->num_contacts; i++) {
        int row = ROW(i);
        float w = first_velocity(a, row, ROW_PARTS(i), path_of_row(a, i), a->y, T(W_JOINTS));
        float old = W(row + ROW_IMPULSE), missing = fma_(W(row + ROW_SOFTNESS), old, w - W(row + ROW_TARGET));
        float normal = max_(nfma(missing, W(row + ROW_INVERSE), old), 0.0f);
        float enough = TC(DEEP_PUSH) < W(row + ROW_PUSH) ? TC(SETTLED_CHANGE_DEEP) : TC(SETTLED_CHANGE);
        W(row + ROW_BEYOND) = fma_(fabsf(normal - old), W(row + ROW_DIAGONAL), -enough);
    }
    BY_THREE for (int i = 0; i < a->num_contacts; i++) beyond = max_(beyond, W(ROW(i) + ROW_BEYOND));
    return 0.0f < beyond;
}

/* One sweep over contacts that regular sweeps have not settled. */
FN void sweep_jammed(Robot *a) {
    ROLLED for (int i = 0; i < a->num_contacts; i++) {
        int row = ROW(i);
        Path path = path_of_row(a, i);
        Rows z;
        load_rows(a, row, &z);
        float friction[2], old[3], w[3], c[3], inverse[3], across[2], s[2];
        sliding_friction(a, ROW_CONTACT(i), friction);
        w_load(a, row + ROW_IMPULSE, 3, old);
        w_load(a, row + ROW_COUPLING, 3, c);
        w_load(a, row + ROW_INVERSE, 3, inverse);
        w_load(a, row + ROW_ACROSS, 2, across);
        velocities(a, &z, ROW_PARTS(i), path, 0, a->y, T(W_JOINTS), w);
        float square = fma_(old[1], old[1], old[2] * old[2]), bound = friction[1] * old[0];
        bound = bound * bound;
        int at_bound = (bound * TC(LEAST_BOUND) < square) & (square < bound * TC(MOST_BOUND));
        int slid = (0.0f < old[0]) & at_bound;
        float per_normal = 1.0f / max_(old[0], (float)1e-9);
        float follow1 = slid ? old[1] * per_normal : 0.0f, follow2 = slid ? old[2] * per_normal : 0.0f;
        float own = W(row + ROW_DIAGONAL);
        float diagonal = fma_(c[0], follow1, fma_(c[1], follow2, own));
        diagonal = max_(diagonal, own * TC(MIN_FOLLOWING_RESPONSE));
        float missing = fma_(W(row + ROW_SOFTNESS), old[0], w[0] - W(row + ROW_TARGET));
        float change = max_(old[0] - missing / diagonal, 0.0f) - old[0];
        int turned = change * W(row + ROW_LAST_CHANGE) < 0.0f;
        float dn = turned ? change * TC(TURN_BACK_SHARE) : change;
        float normal = old[0] + dn;
        float followed1 = fma_(follow1, dn, old[1]), followed2 = fma_(follow2, dn, old[2]);
        float w1 = fma_(fma_(follow2, c[2], fma_(follow1, across[0], c[0])), dn, w[1]);
        float w2 = fma_(fma_(follow1, c[2], fma_(follow2, across[1], c[1])), dn, w[2]);
        float t1 = nfma(w1, inverse[1], followed1);
        float t2 = nfma(fma_(c[2], t1 - followed1, w2), inverse[2], followed2);
        float hold = (turned ? friction[1] : friction[0]) * normal;
        int slides = hold * hold < fma_(t1, t1, t2 * t2);
        sliding(W(row + ROW_SLIDE), w1, w2, followed1, followed2, friction[1] * normal, s);
        float now[3] = {normal, slides ? s[0] : t1, slides ? s[1] : t2}, moved[3];
        sub(now, old, moved);
        apply_rows(a, &z, ROW_PARTS(i), path, 0, moved, a->y, T(W_JOINTS));
        W(row + ROW_LAST_CHANGE) = dn;
        w_store(a, row + ROW_IMPULSE, 3, now);
    }
}

/* Marks the bounds that sweeps look at. */
FN void mark_active(Robot *a) {
    ROLLED for (int b = 0; b < T(BLOCKS); b++) {
        int active = 0;
        for (int i = 0; i < BLOCK; i++) {
            if (NEAR_LIMIT(b, i)) active = 1;
            if (HAS_FRICTION(b, i)) active |= 0.0f < W(BOUND_ROW(b, i) + MAX_FRICTION);
        }
        BLOCK_ACTIVE(b) = active;
    }
}

/* Keeps the sparse velocity in the memory of the moved one. */
FN void keep_velocity(Robot *a) {
    copy(a->moved, a->y, 6);
    ROLLED for (int k = 0; k < NUM_VELOCITIES; k++) W(T(W_MOVED) + k) = W(T(W_JOINTS) + k);
}

/* Whether the velocity differs from the one that was kept by more than the settings allow. */
FN int changed(const Robot *a) {
    float energy = 0.0f;
    BY_THREE for (int k = 0; k < NUM_VELOCITIES; k++) {
        float change = W(T(W_JOINTS) + k) - W(T(W_MOVED) + k);
        energy = fma_(change, change, energy);
    }
    for (int r = 0; r < 6; r++) {
        float change = a->y[r] - a->moved[r];
        energy = fma_(change, change, energy);
    }
    return TC(MIN_CHANGE_SQUARED) < energy * a->compliance;
}

/* The push out of penetrations and back from beyond limits: it moves bodies alone. */
FN void push_out(Robot *a) {
    int joints = T(W_MOVED);
    mark_active(a);
    ROLLED for (int sweep = 0; sweep < T(PUSH_SWEEPS); sweep++) {
        float most = 0.0f;
        ROLLED for (int i = 0; i < a->num_contacts; i++) {
            int row = ROW(i);
            Path path = path_of_row(a, i);
            float w = first_velocity(a, row, ROW_PARTS(i), path, a->moved, joints);
            float old = W(row + ROW_PUSH_IMPULSE), missing = fma_(W(row + ROW_SOFTNESS), old, w - W(row + ROW_PUSH));
            float push = max_(nfma(missing, W(row + ROW_INVERSE), old), 0.0f), change = push - old;
            most = max_(most, fabsf(change * W(row + ROW_DIAGONAL)));
            apply_first(a, row, ROW_PARTS(i), path, change, a->moved, joints);
            W(row + ROW_PUSH_IMPULSE) = push;
        }
        most = max_(most, sweep_limits(a, 1, a->moved, joints));
        if (!(TC(PUSH_TOLERANCE) < most)) break;
    }
    settle_limits(a, 1, a->moved, joints);
}

/* Solves the constraints. */
FN void solve_rows(Robot *a) {
    warm_start(a);
    ROLLED for (int sweep = 1; sweep <= T(ITERATIONS); sweep++) {
        int measures = T(MEASURES) && T(CHECK_INTERVAL) > 0 && sweep % T(CHECK_INTERVAL) == 0 && sweep < T(ITERATIONS);
        if (measures) keep_velocity(a);
        sweep_bounds(a);
        sweep_spins(a);
        sweep_contacts(a);
        if (measures) {
            if (!changed(a)) break;
            mark_active(a);
        }
    }
    ROLLED for (int round = 0; round <= T(MAX_EXTRA_ROUNDS); round++) {
        if (round > 0) {
            int sweeps = T(ITERATIONS) < T(SWEEPS_PER_ROUND) ? T(ITERATIONS) : T(SWEEPS_PER_ROUND);
            ROLLED for (int sweep = 0; sweep < sweeps; sweep++) {
                sweep_bounds(a);
                sweep_spins(a);
                sweep_jammed(a);
            }
        }
        settle_limits(a, 0, a->y, T(W_JOINTS));
        if (!unsettled(a)) break;
        mark_active(a);
    }
    if (0.0f < a->violation) {
        keep_velocity(a);
        push_out(a);
    }
}

FN void solve(Robot *a) {
    SYNC;
    if (IS_FIRST(a)) solve_rows(a);
    SYNC;
    for (int r = 0; r < 6; r++) {
        a->y[r] = FROM_LANE(a->y[r], 0);
        a->moved[r] = FROM_LANE(a->moved[r], 0);
    }
}
#endif
