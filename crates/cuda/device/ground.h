/* Contacts with the ground: crates/dynamics/src/ground.rs, ground_contacts.rs, gaps.rs and
 * spin_rows.rs. */
#ifndef POLYPOD_GROUND_H
#define POLYPOD_GROUND_H
#include "rows.h"
#include "terrain.h"

/* Largest gap that may close in a step, m. */
FN float reach_in_step(const Robot *a, float least, float now, float free) {
    return nfma(min_(min_(now, free), 0.0f), TC(DT), least);
}

/* Speed at which a violation of some depth is pushed out, m/s. A depth of `slop` is left. */
FN float push_speed(const Robot *a, float depth, float slop, float inverse_dt) {
    float beyond = max_(depth - slop, 0.0f);
    return min_(beyond * TC(CORRECTION) * inverse_dt, TC(MAX_PUSH));
}

/* Least allowed separation speed at a gap, m/s. */
FN float separation(const Robot *a, float gap, float inverse_dt) {
    float push = push_speed(a, -gap, TC(PENETRATION_SLOP), inverse_dt);
    return gap < 0.0f ? push : -(gap * inverse_dt);
}

/* The lowest point of a candidate, in link axes; `up` is the world's up in link axes. */
FN void candidate_point(const Robot *a, int contact, const float *up, float *o) {
    p_load(a, P_CONTACT_POSITION, 3 * contact, 3, o);
    if (!L(T(T_CONTACT) + contact * CONTACT_SIZE + 2)) return;
    const float *e = C(T(C_RIM) + contact * RIM_SIZE);
    float c = -dot(e, up), s = -dot(e + 3, up);
    float length = sqrtf(fma_(c, c, s * s));
    /* an upright cylinder has no lowest rim point: take fixed ones */
    int upright = length < (float)1e-3;
    float inverse = 1.0f / length;
    c = upright ? 1.0f : c * inverse;
    s = upright ? 0.0f : s * inverse;
    float tc = e[6], ts = e[7];
    float c1 = fma_(c, tc, -(s * ts)), s1 = fma_(s, tc, c * ts), rim = P(P_CONTACT_RIM, contact);
    add_scaled(o, e, c1 * rim, o);
    add_scaled(o, e + 3, s1 * rim, o);
}

/* Torsional and rolling friction of contact i. */
FN void add_spin(Robot *a, int i, const float *frame) {
    int spin = SPIN(i), path = ROW_PATH(i);
    float base[18], own[9], product[6], least = a->compliance * TC(MIN_TANGENT_COMPLIANCE);
    for (int d = 0; d < 3; d++) {
        copy(base + 6 * d, frame + 3 * d, 3);
        set3(base + 6 * d + 3, 0.0f, 0.0f, 0.0f);
    }
    build_rows(a, path, base, own, SPIN_PARTS(i));
    products(a, base, own, SPIN_PARTS(i), path, 0, product);
    w_store(a, spin, 18, base);
    w_store(a, spin + ROW_OWN, 9, own);
    float difference = (product[1] - product[2]) * 0.5f;
    float radius = sqrtf(fma_(difference, difference, product[5] * product[5]));
    w_store(a, spin + ROW_COUPLING, 3, product + 3);
    for (int d = 0; d < 3; d++) W(spin + ROW_INVERSE + d) = 1.0f / max_(product[d], least);
    last_impulse(a, T(ROWS) + ROW_CONTACT(i), spin + SPIN_IMPULSE);
    W(spin + SPIN_ROLL) = 1.0f / max_(fma_(product[1] + product[2], 0.5f, radius), least);
}

#define GROUND(link) (T(W_GROUND) + (link) * GROUND_SIZE)

/* Whether a link is near the ground; `frame` holds the axes of a level plane. Gives the height of its
 * origin, the world's up in link axes, and how high a candidate may be. */
FN int is_near_ground(const Robot *a, int link, const float *position, const float *frame, const float *r,
                      const float *x, float *height, float *up, float *highest) {
    float margin = TC(GROUND_MARGIN), box[6];
    *height = dot(C(PLANE), position) - TC(PLANE_OFFSET) + dot(frame, x);
    mul_vec_transposed(r, frame, up);
    p_load(a, P_LINK_BOX, 6 * link, 6, box);
    *highest = margin;
    if (T(HAS_GRID)) {
        float place[3];
        mul_vec(r, box, place);
        add(x, place, place);
        world_place(frame, position, place, place);
        float bound = terrain_bound(a, 0, place[0], place[1], sqrtf(dot(box + 3, box + 3)) + margin);
        *highest = margin + bound - TC(PLANE_OFFSET);
    }
    float below = fma_(box[3], fabsf(up[0]), fma_(box[4], fabsf(up[1]), box[5] * fabsf(up[2])));
    return *height + dot(up, box) - below < *highest;
}

/* Finds the contacts near the ground, link by link. `free_base` is the velocity that the base would have
 * without constraints, in base axes about its origin. */
FN void find_ground_contacts(Robot *a, const float *free_base, const float *frame, List *list) {
    float margin = TC(GROUND_MARGIN), position[3], r[9], x[3], up[3], origin_height, highest;
    s_load(a, T(S_POSITION), 3, position);
#if LANES > 1
    SHARED_OUT(link, T(JOINTS) + 1) {
        if (L(T(T_LINK_CONTACTS) + link) == L(T(T_LINK_CONTACTS) + link + 1)) continue;
        w_load(a, LINK(link), 9, r);
        w_load(a, LINK(link) + LINK_POSITION, 3, x);
        int near = is_near_ground(a, link, position, frame, r, x, &origin_height, up, &highest);
        I(T(I_PLACED) + link) = near;
        if (!near) continue;
        W(GROUND(link)) = origin_height;
        w_store(a, GROUND(link) + GROUND_UP, 3, up);
        W(GROUND(link) + GROUND_HIGHEST) = highest;
    }
    SYNC;
#endif
    ROLLED for (int link = 0; link <= T(JOINTS); link++) {
        int first = L(T(T_LINK_CONTACTS) + link), end = L(T(T_LINK_CONTACTS) + link + 1);
        if (first == end) continue;
#if LANES > 1
        if (!I(T(I_PLACED) + link)) continue;
        origin_height = W(GROUND(link));
        highest = W(GROUND(link) + GROUND_HIGHEST);
        w_load(a, GROUND(link) + GROUND_UP, 3, up);
#endif
        w_load(a, LINK(link), 9, r);
        w_load(a, LINK(link) + LINK_POSITION, 3, x);
#if LANES == 1
        if (!is_near_ground(a, link, position, frame, r, x, &origin_height, up, &highest)) continue;
#endif
        float now_moving[6], free_moving[6];
        w_load(a, LINK(link) + LINK_VELOCITY, 6, now_moving);
        w_load(a, LINK(link) + LINK_FREE, 6, free_moving);
        /* link velocities leave the base's linear velocity out */
        for (int k = 0; k < 6; k++) now_moving[k] = now_moving[k] + (k < 3 ? 0.0f : a->velocity_base[k]);
        for (int k = 0; k < 6; k++) free_moving[k] = free_moving[k] + free_base[k];
        ROLLED for (int c = first + a->lane; c < end; c += LANES) {
            float radius = P(P_CONTACT_RADIUS, c), local[3], centre[3];
            float reach = radius + P(P_CONTACT_RIM, c);
            p_load(a, P_CONTACT_POSITION, 3 * c, 3, local);
            if (!(origin_height + dot(up, local) - reach < highest)) continue;
            candidate_point(a, c, up, local);
            float gap = origin_height + dot(up, local) - radius;
            if (!(gap < highest)) continue;
            float surface[9];
            const float *axes = frame;
            mul_vec(r, local, centre);
            add(x, centre, centre);
            if (T(HAS_GRID)) {
                float place[3];
                world_place(frame, position, centre, place);
                float bound = terrain_bound(a, 1, place[0], place[1], radius + margin);
                if (!(gap < margin + bound - TC(PLANE_OFFSET))) continue;
                gap = on_terrain(a, frame, place, radius, surface);
                if (!(gap < margin)) continue;
                axes = surface;
            }
            float v[3];
            at_point(now_moving, centre, v);
            float now = dot(axes, v);
            at_point(free_moving, centre, v);
            float free = dot(axes, v);
            if (!(gap < min_(reach_in_step(a, TC(GROUND_REACH), now, free), margin))) continue;
            float point[3];
            scale(axes, radius, point);
            sub(centre, point, point);
            w_store(a, FOUND(c) + FOUND_POINT, 3, point);
            W(FOUND(c) + FOUND_GAP) = gap;
            if (T(HAS_GRID)) w_store(a, FOUND(c) + FOUND_FRAME, 9, axes);
            list_append(a, list, T(I_NEXT), c);
        }
    }
}

/* Finds the contacts near the ground and builds their rows after the search, in which threads find
 * theirs at different times. */
FN void build_ground_contacts(Robot *a, const float *free_base) {
    float inverse_dt = 1.0f / TC(DT), frame[9];
    List list = {0, -1};
    a->num_contacts = a->num_spins = 0;
    if (!T(HAS_GROUND)) return;
    for (int d = 0; d < 3; d++) mul_vec_transposed(a->base_rotation, C(PLANE + 3 * d), frame + 3 * d);
    find_ground_contacts(a, free_base, frame, &list);
    a->num_contacts = number_contacts(a, &list, 0);
    if (T(FRICTION)) a->num_spins = a->num_contacts;
    SHARED_OUT(i, a->num_contacts) {
        int row = ROW(i), found = FOUND(ROW_CONTACT(i)), path = L(T(T_CONTACT) + ROW_CONTACT(i) * CONTACT_SIZE);
        float point[3], axes[9], base[18], own[9], gap = W(found + FOUND_GAP);
        keep_path(a, i, path);
        ROW_PAIR(i) = -1;
        w_load(a, found + FOUND_POINT, 3, point);
        copy(axes, frame, 9);
        if (T(HAS_GRID)) {
            w_load(a, found + FOUND_FRAME, 9, axes);
            w_store(a, row + ROW_FRAME, 9, axes);
        }
        set_directions(point, axes, base);
        build_rows(a, path, base, own, ROW_PARTS(i));
        finish_rows(a, i, base, own, TC(GROUND_COMPLIANCE));
        float bounce = NO_TARGET, restitution = P(P_RESTITUTION, 0);
        if (0.0f < restitution) {
            /* the sparse velocity is that before the step */
            float approach = first_velocity(a, row, ROW_PARTS(i), path_of(a, path), a->y, T(W_JOINTS));
            int bounces = (approach < TC(BOUNCE_SPEED)) & (gap < -(approach * TC(DT)));
            if (bounces) bounce = -(approach * restitution);
        }
        add_contact(a, i, separation(a, gap, inverse_dt), bounce);
        if (T(FRICTION)) add_spin(a, i, axes);
    }
}
#endif
