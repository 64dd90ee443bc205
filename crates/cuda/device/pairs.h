/* Contacts between a robot's own links: crates/dynamics/src/self_contact.rs and proximity.rs. */
#ifndef POLYPOD_PAIRS_H
#define POLYPOD_PAIRS_H
#include "ground.h"

/* Squared length below which a vector between two shapes has no direction, m^2. */
#define MIN_SQUARED_LENGTH ((float)1e-10)
#define SEGMENT_HALVINGS 9

#define PLACED(c) (T(W_COLLIDER) + (c) * PLACED_SIZE)
#define LINK_BOX(l) (T(W_LINK_BOX) + (l) * LINK_BOX_SIZE)
#define IS_BOX(c) (T(T(T_COLLIDER) + (c) * COLLIDER_SIZE + 2))
#define COLLIDER_LINK(c) (T(T(T_COLLIDER) + (c) * COLLIDER_SIZE))

typedef struct {
    float centre[3], half[3], radius;
} Capsule;

/* Distance of the surfaces, the unit normal from the second to the first, the middle between the
 * nearest points. */
typedef struct {
    float gap, normal[3], point[3];
} Proximity;

/* Largest distance along an axis of two boxes, m, by columns of their centres and half edges. */
FN float box_distance(const Robot *a, int c1, int e1, int c2, int e2) {
    float most = fabsf(W(c1) - W(c2)) - (W(e1) + W(e2));
    for (int i = 1; i < 3; i++) most = max_(most, fabsf(W(c1 + i) - W(c2 + i)) - (W(e1 + i) + W(e2 + i)));
    return most;
}

FN void turned_extent(const float *r, const float *half, float *o) {
    float x[3];
    for (int i = 0; i < 3; i++)
        x[i] = fma_(fabsf(r[3 * i]), half[0], fma_(fabsf(r[3 * i + 1]), half[1], fabsf(r[3 * i + 2]) * half[2]));
    copy(o, x, 3);
}

/* At least half the square of the largest speed of a body's points within the root of
 * `squared_reach` of `centre`. */
CALLED float half_squared_speed(const float *velocity, const float *centre, float squared_reach) {
    float point[3];
    at_point(velocity, centre, point);
    return fma_(squared_reach, dot(velocity, velocity), dot(point, point));
}

/* Puts a box around the colliders of each link, and finds how fast any point of it moves. */
FN void box_links(Robot *a) {
    for (int link = 0; link <= T(JOINTS); link++) {
        if (T(T(T_LINK_COLLIDERS) + 2 * link) == 0) continue;
        float box[6], r[9], x[3], centre[3], extent[3], motion[6], speed = 0.0f;
        p_load(a, T(P_LINK_BOX) + 6 * link, 6, box);
        w_load(a, LINK(link), 9, r);
        w_load(a, LINK(link) + LINK_POSITION, 3, x);
        mul_vec(r, box, centre);
        add(x, centre, centre);
        turned_extent(r, box + 3, extent);
        /* seen from itself, the base does not move */
        if (link > 0) {
            float squared_reach = dot(box + 3, box + 3);
            for (int k = 0; k < 6; k++) motion[k] = W(LINK(link) + LINK_VELOCITY + k) - W(LINK(0) + LINK_VELOCITY + k);
            float now = half_squared_speed(motion, centre, squared_reach);
            w_load(a, LINK(link) + LINK_FREE, 6, motion);
            float free = half_squared_speed(motion, centre, squared_reach);
            speed = sqrtf(2.0f * max_(now, free));
        }
        w_store(a, LINK_BOX(link), 3, centre);
        w_store(a, LINK_BOX(link) + 3, 3, extent);
        W(LINK_BOX(link) + 6) = speed;
        I(T(I_PLACED) + link) = 0;
    }
}

/* Puts a collider where its link is. */
CALLED void place_collider(Robot *a, int c) {
    int link = COLLIDER_LINK(c), to = PLACED(c);
    float r[9], x[3], centre[3], half[3], extent[3], rotation[9], radius = P(T(P_COLLIDER_RADIUS) + c);
    w_load(a, LINK(link), 9, r);
    w_load(a, LINK(link) + LINK_POSITION, 3, x);
    p_load(a, T(P_COLLIDER_CENTRE) + 3 * c, 3, centre);
    p_load(a, T(P_COLLIDER_HALF) + 3 * c, 3, half);
    mul_vec(r, centre, centre);
    add(x, centre, centre);
    if (IS_BOX(c)) {
        mul_mat(r, a->c + T(C_BOX) + 9 * c, rotation);
        w_store(a, to + PLACED_ROTATION, 9, rotation);
        turned_extent(rotation, half, extent);
    } else {
        mul_vec(r, half, half);
        for (int i = 0; i < 3; i++) extent[i] = fabsf(half[i]) + radius;
    }
    w_store(a, to, 3, centre);
    w_store(a, to + PLACED_HALF, 3, half);
    W(to + PLACED_RADIUS) = radius;
    w_store(a, to + PLACED_EXTENT, 3, extent);
}

FN void load_capsule(const Robot *a, int c, Capsule *o) {
    w_load(a, PLACED(c), 3, o->centre);
    w_load(a, PLACED(c) + PLACED_HALF, 3, o->half);
    o->radius = W(PLACED(c) + PLACED_RADIUS);
}

/* Where two capsules come nearest: places on their axes, on that of the first from `from` to `to`. */
CALLED void nearest_on_capsules(const Capsule *a, float from, float to, float middle, const Capsule *b, float *o) {
    float tiny = MIN_SQUARED_LENGTH, between[3];
    sub(a->centre, b->centre, between);
    float aa = dot(a->half, a->half), bb = dot(b->half, b->half), ab = dot(a->half, b->half);
    float ac = dot(a->half, between), bc = dot(b->half, between);
    float determinant = nfma(ab, ab, aa * bb);
    int crosses = tiny * max_(aa * bb, tiny) < determinant;
    float s = crosses ? fma_(ab, bc, -(bb * ac)) / max_(determinant, tiny * tiny) : middle;
    s = clamp_(s, from, to);
    float t = clamp_(fma_(ab, s, bc) / max_(bb, tiny), -1.0f, 1.0f);
    o[0] = clamp_(fma_(ab, t, -ac) / max_(aa, tiny), from, to);
    o[1] = t;
}

/* Distance of two capsules at the places s and t of their axes. */
FN void capsules(const Capsule *a, float s, const Capsule *b, float t, Proximity *o) {
    float on_a[3], on_b[3], apart[3], surface[3];
    add_scaled(a->centre, a->half, s, on_a);
    add_scaled(b->centre, b->half, t, on_b);
    sub(on_a, on_b, apart);
    float squared = dot(apart, apart);
    int meets = squared < MIN_SQUARED_LENGTH;
    float distance = sqrtf(max_(squared, MIN_SQUARED_LENGTH)), inverse = 1.0f / distance;
    if (meets)
        set3(o->normal, 0.0f, 0.0f, 1.0f);
    else
        scale(apart, inverse, o->normal);
    o->gap = (meets ? 0.0f : distance) - a->radius - b->radius;
    add_scaled(on_b, o->normal, b->radius, surface);
    add_scaled(surface, o->normal, o->gap * 0.5f, o->point);
}

FN void clamped(const float *p, const float *half, float *o) {
    set3(o, clamp_(p[0], -half[0], half[0]), clamp_(p[1], -half[1], half[1]), clamp_(p[2], -half[2], half[2]));
}

/* Half of how the squared distance of a point of a capsule's axis from a box changes along the axis. */
CALLED float slope_to_box(const Capsule *a, float t, const float *box) {
    float p[3], c[3];
    add_scaled(a->centre, a->half, t, p);
    clamped(p, box, c);
    sub(p, c, c);
    return dot(c, a->half);
}

/* Where on a capsule's axis it comes nearest to a box about the origin: on either half, or on all of it. */
FN void nearest_to_box(const Capsule *a, const float *box, int halves, float *o) {
    float t = 0.0f, quarter = 0.5f, first = 0.0f;
    if (halves) {
        first = slope_to_box(a, 0.0f, box);
        quarter = 0.25f;
        t = first < 0.0f ? 0.5f : -0.5f;
    }
    for (int halving = 0; halving < SEGMENT_HALVINGS; halving++) {
        float slope = slope_to_box(a, t, box), down = 0.0f < slope ? -quarter : 0.0f;
        t = t + (slope < 0.0f ? quarter : down);
        if (halving + 2 < SEGMENT_HALVINGS) quarter = quarter * 0.5f;
    }
    o[0] = halves && first < 0.0f ? 0.0f : t;
    o[1] = halves && !(first < 0.0f) ? 0.0f : t;
}

/* Distance of the point t of a capsule's axis and a box about the origin. */
FN void capsule_and_box(const Capsule *a, float t, const float *box, Proximity *o) {
    float p[3], c[3], out[3], surface[3];
    add_scaled(a->centre, a->half, t, p);
    clamped(p, box, c);
    sub(p, c, out);
    float squared = dot(out, out);
    int inside = squared < MIN_SQUARED_LENGTH;
    float distance = sqrtf(max_(squared, MIN_SQUARED_LENGTH));
    float depth[3] = {box[0] - fabsf(p[0]), box[1] - fabsf(p[1]), box[2] - fabsf(p[2])};
    /* inside, the nearest face is the way out */
    int x_first = (depth[0] < depth[1]) & (depth[0] < depth[2]), y_first = depth[1] < depth[2];
    float shallow = min_(min_(depth[0], depth[1]), depth[2]), inverse = 1.0f / distance;
    if (inside) {
        set3(o->normal, x_first ? (p[0] < 0.0f ? -1.0f : 1.0f) : 0.0f,
             !x_first && y_first ? (p[1] < 0.0f ? -1.0f : 1.0f) : 0.0f,
             !x_first && !y_first ? (p[2] < 0.0f ? -1.0f : 1.0f) : 0.0f);
    } else {
        scale(out, inverse, o->normal);
    }
    float away = inside ? -shallow : distance;
    o->gap = away - a->radius;
    scale(o->normal, away, surface);
    sub(p, surface, surface);
    add_scaled(surface, o->normal, o->gap * 0.5f, o->point);
}

/* A normal and two tangents. */
FN void pair_frame(const float *normal, float *frame) {
    int x_like = fabsf(normal[1]) < fabsf(normal[0]);
    float along[3] = {x_like ? 0.0f : 1.0f, x_like ? 1.0f : 0.0f, 0.0f}, t[3];
    add_scaled(along, normal, -dot(along, normal), t);
    copy(frame, normal, 3);
    scale(t, 1.0f / sqrtf(dot(t, t)), frame + 3);
    cross(normal, frame + 3, frame + 6);
}

/* Velocity at which two links part along a normal at a point; `of` is a column of their motions. */
FN float parting(const Robot *a, const int *links, int of, const Proximity *found) {
    float motion[6], first[3], second[3];
    w_load(a, LINK(links[0]) + of, 6, motion);
    at_point(motion, found->point, first);
    w_load(a, LINK(links[1]) + of, 6, motion);
    at_point(motion, found->point, second);
    sub(first, second, first);
    return dot(found->normal, first);
}

/* Builds the rows of a pair of links that touch: equal and opposite forces along the axes of a frame. */
FN void build_pair(Robot *a, int pair, int contact, const Proximity *found) {
    int at = T(T_PAIR) + pair * PAIR_SIZE, path = T(at + 5), i = a->num_contacts, row = ROW(i);
    float frame[9];
    pair_frame(found->normal, frame);
    ROW_CONTACT(i) = contact;
    ROW_PATH(i) = path;
    ROW_PAIR(i) = pair;
    set_directions(a, row, found->point, frame);
    for (int p = 0; p < PATH_PARTS(path); p++) {
        int out = p == 0 ? row + ROW_OWN : ROW_PARTS(i) + 9 * (p - 1);
        joint_rows(a, PART(path, p), row, out);
        /* a link that carries both feels nothing */
        for (int k = 0; k < 9; k++) W(out + k) = W(out + k) * (float)(T(T(at + 7) + BLOCK * p + k / 3) - 1);
    }
    for (int k = 0; k < 18; k++) W(row + k) = 0.0f;
    half_solve_rows(a, row, ROW_PARTS(i), path);
    w_store(a, row + ROW_FRAME, 9, frame);
    finish_rows(a, TC(PAIR_COMPLIANCE));
}

/* The contacts of two colliders, whose boxes are near each other. */
FN void touch_pair(Robot *a, int pair, float margin) {
    int at = T(T_PAIR) + pair * PAIR_SIZE, first = T(at), second = T(at + 1), parts = T(at + 4);
    int links[2] = {COLLIDER_LINK(first), COLLIDER_LINK(second)}, is_box = IS_BOX(second);
    Capsule capsule, other;
    float places[4], rotation[9], t[3];
    load_capsule(a, first, &capsule);
    load_capsule(a, second, &other);
    if (is_box) {
        w_load(a, PLACED(second) + PLACED_ROTATION, 9, rotation);
        sub(capsule.centre, other.centre, t);
        mul_vec_transposed(rotation, t, capsule.centre);
        copy(t, capsule.half, 3);
        mul_vec_transposed(rotation, t, capsule.half);
        float reach = capsule.radius + margin, apart = -reach;
        for (int i = 0; i < 3; i++)
            apart = max_(apart, fabsf(capsule.centre[i]) - fabsf(capsule.half[i]) - other.half[i]);
        if (!(apart < reach)) return;
        float halves[2];
        nearest_to_box(&capsule, other.half, parts == 2, halves);
        places[0] = places[1] = halves[0];
        places[2] = places[3] = halves[1];
    } else {
        sub(capsule.centre, other.centre, t);
        float rest = capsule.radius + other.radius + margin;
        float lengths = 2.0f * (dot(capsule.half, capsule.half) + dot(other.half, other.half));
        if (!(dot(t, t) < 2.0f * (rest * rest + lengths))) return;
        if (parts == 2) {
            nearest_on_capsules(&capsule, -1.0f, 0.0f, -0.5f, &other, places);
            nearest_on_capsules(&capsule, 0.0f, 1.0f, 0.5f, &other, places + 2);
        } else {
            nearest_on_capsules(&capsule, -1.0f, 1.0f, 0.0f, &other, places);
        }
    }
    for (int i = 0; i < parts; i++) {
        Proximity found;
        if (is_box) {
            capsule_and_box(&capsule, places[2 * i], other.half, &found);
            mul_vec(rotation, found.normal, t);
            copy(found.normal, t, 3);
            mul_vec(rotation, found.point, t);
            add(other.centre, t, found.point);
        } else {
            capsules(&capsule, places[2 * i], &other, places[2 * i + 1], &found);
        }
        float now = parting(a, links, LINK_VELOCITY, &found), free = parting(a, links, LINK_FREE, &found);
        if (!(found.gap < reach_in_step(a, TC(PAIR_REACH), now, free))) continue;
        int contact = T(at + 6) + i;
        build_pair(a, pair, contact, &found);
        add_contact(a, contact, separation(a, found.gap, 1.0f / TC(DT)), NO_TARGET);
    }
}

/* Finds the pairs of links that are near each other and builds their rows. */
FN void build_pairs(Robot *a) {
    if (T(PAIRS) == 0) return;
    box_links(a);
    for (int group = 0; group < T(GROUPS); group++) {
        int at = T(T_GROUP) + group * GROUP_SIZE, first = LINK_BOX(T(at)), second = LINK_BOX(T(at + 1));
        float margin = fma_(W(first + 6) + W(second + 6), TC(DT), TC(PAIR_REACH)), wide = margin + TC(PAIR_ROUNDING);
        if (!(box_distance(a, first, first + 3, second, second + 3) < wide)) continue;
        for (int i = 0; i < 2; i++) {
            int link = T(at + i), colliders = T(T_LINK_COLLIDERS) + 2 * link;
            if (I(T(I_PLACED) + link)) continue;
            I(T(I_PLACED) + link) = 1;
            for (int k = 0; k < T(colliders); k++) place_collider(a, T(T(colliders + 1) + k));
        }
        for (int pair = T(at + 2); pair < T(at + 2) + T(at + 3); pair++) {
            int one = PLACED(T(T(T_PAIR) + pair * PAIR_SIZE)), two = PLACED(T(T(T_PAIR) + pair * PAIR_SIZE + 1));
            if (!(box_distance(a, one, one + PLACED_EXTENT, two, two + PLACED_EXTENT) < wide)) continue;
            touch_pair(a, pair, wide);
        }
    }
}
#endif
