/* Contacts between a robot's own links: crates/dynamics/src/self_contact.rs and proximity.rs. */
#ifndef POLYPOD_PAIRS_H
#define POLYPOD_PAIRS_H
#include "ground.h"

/* Squared length below which a vector between two shapes has no direction, m^2. */
#define MIN_SQUARED_LENGTH ((float)1e-10)
#define SEGMENT_HALVINGS 9

#define PLACED(c) (T(W_COLLIDER) + (c) * PLACED_SIZE)
#define LINK_BOX(l) (T(W_LINK_BOX) + (l) * LINK_BOX_SIZE)
/* the pair of colliders that a contact was found on */
#define PAIR_OF(contact) I(T(I_NEXT_PAIR) + T(PAIRS) + (contact) - T(CONTACTS))
#define IS_BOX(c) (L(T(T_COLLIDER) + (c) * COLLIDER_SIZE + 2))
#define COLLIDER_LINK(c) (L(T(T_COLLIDER) + (c) * COLLIDER_SIZE))

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
FN float half_squared_speed(const float *velocity, const float *centre, float squared_reach) {
    float point[3];
    at_point(velocity, centre, point);
    return fma_(squared_reach, dot(velocity, velocity), dot(point, point));
}

/* Puts a box around the colliders of each link, and finds how fast any point of it moves. */
FN void box_links(Robot *a) {
    SHARED_OUT(link, T(JOINTS) + 1) {
        if (L(T(T_LINK_COLLIDERS) + 2 * link) == 0) continue;
        float box[6], r[9], x[3], centre[3], extent[3], motion[6], speed = 0.0f;
        p_load(a, P_LINK_BOX, 6 * link, 6, box);
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
FN void place_collider(Robot *a, int c) {
    int link = COLLIDER_LINK(c), to = PLACED(c);
    float r[9], x[3], centre[3], half[3], extent[3], rotation[9], radius = P(P_COLLIDER_RADIUS, c);
    w_load(a, LINK(link), 9, r);
    w_load(a, LINK(link) + LINK_POSITION, 3, x);
    p_load(a, P_COLLIDER_CENTRE, 3 * c, 3, centre);
    p_load(a, P_COLLIDER_HALF, 3 * c, 3, half);
    mul_vec(r, centre, centre);
    add(x, centre, centre);
    if (IS_BOX(c)) {
        mul_mat(r, C(T(C_BOX) + 9 * c), rotation);
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
FN void nearest_on_capsules(const Capsule *a, float from, float to, float middle, const Capsule *b, float *o) {
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
FN float slope_to_box(const Capsule *a, float t, const float *box) {
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
    ROLLED for (int halving = 0; halving < SEGMENT_HALVINGS; halving++) {
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

/* Builds the rows of a contact of two links, which was found: equal and opposite forces along the axes
 * of a frame. */
FN void build_pair(Robot *a, int i) {
    int row = ROW(i), found = FOUND(ROW_CONTACT(i)), pair = PAIR_OF(ROW_CONTACT(i));
    int at = T(T_PAIR) + pair * PAIR_SIZE, path = L(at + 5);
    float normal[3], point[3], frame[9], base[18], own[9], gap = W(found + FOUND_GAP);
    keep_path(a, i, path);
    ROW_PAIR(i) = pair;
    w_load(a, found + FOUND_POINT, 3, point);
    w_load(a, found + FOUND_NORMAL, 3, normal);
    pair_frame(normal, frame);
    set_directions(point, frame, base);
    for (int k = 0; k < 9; k++) own[k] = 0.0f;
    ROLLED for (int p = PATH_PARTS(path) - 1; p >= 0; p--) {
        joint_rows(a, PART(path, p), base, own);
        /* a link that carries both feels nothing */
        for (int k = 0; k < 9; k++) own[k] = own[k] * (float)(L(L(at + 7) + BLOCK * p + k / 3) - 1);
        if (p > 0) w_store(a, ROW_PARTS(i) + 9 * (p - 1), 9, own);
    }
    for (int k = 0; k < 18; k++) base[k] = 0.0f;
    half_solve_rows(a, base, own, ROW_PARTS(i), path);
    w_store(a, row + ROW_FRAME, 9, frame);
    finish_rows(a, i, base, own, TC(PAIR_COMPLIANCE));
    add_contact(a, i, separation(a, gap, 1.0f / TC(DT)), NO_TARGET);
}

/* Distance below which the boxes of two links are near each other. */
FN float near_distance(const Robot *a, int first, int second) {
    return fma_(W(LINK_BOX(first) + 6) + W(LINK_BOX(second) + 6), TC(DT), TC(PAIR_REACH)) + TC(PAIR_ROUNDING);
}

FN int links_near(const Robot *a, int group) {
    int first = L(group), second = L(group + 1), one = LINK_BOX(first), two = LINK_BOX(second);
    return box_distance(a, one, one + 3, two, two + 3) < near_distance(a, first, second);
}

/* Finds the contacts of two colliders, whose boxes are near each other. */
FN void touch_pair(Robot *a, int pair, List *list) {
    int at = T(T_PAIR) + pair * PAIR_SIZE, first = L(at), second = L(at + 1), parts = L(at + 4);
    int links[2] = {COLLIDER_LINK(first), COLLIDER_LINK(second)}, is_box = IS_BOX(second);
    float margin = near_distance(a, links[0], links[1]);
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
    ROLLED for (int i = 0; i < parts; i++) {
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
        int contact = L(at + 6) + i;
        w_store(a, FOUND(contact) + FOUND_POINT, 3, found.point);
        w_store(a, FOUND(contact) + FOUND_NORMAL, 3, found.normal);
        W(FOUND(contact) + FOUND_GAP) = found.gap;
        PAIR_OF(contact) = pair;
        list_append(a, list, T(I_NEXT), contact);
    }
}

/* Finds the pairs of links that are near each other and builds their rows. Each stage looks at all
 * links, pairs or contacts before the next one: the robots of a warp stay together. */
FN void build_pairs(Robot *a) {
    List near = {0, -1}, list = {0, -1};
    int first = a->num_contacts;
    if (T(PAIRS) == 0) return;
    SYNC;
    box_links(a);
    SYNC;
    SHARED_OUT(group, T(GROUPS)) {
        int at = T(T_GROUP) + group * GROUP_SIZE;
        if (links_near(a, at)) I(T(I_PLACED) + L(at)) = I(T(I_PLACED) + L(at + 1)) = 1;
    }
    SYNC;
    SHARED_OUT(c, T(COLLIDERS)) {
        if (I(T(I_PLACED) + COLLIDER_LINK(c))) place_collider(a, c);
    }
    SYNC;
    SHARED_OUT(group, T(GROUPS)) {
        int at = T(T_GROUP) + group * GROUP_SIZE, begin = L(at + 2);
        if (!links_near(a, at)) continue;
        float distance = near_distance(a, L(at), L(at + 1));
        ROLLED for (int pair = begin; pair < begin + L(at + 3); pair++) {
            int one = PLACED(L(T(T_PAIR) + pair * PAIR_SIZE)), two = PLACED(L(T(T_PAIR) + pair * PAIR_SIZE + 1));
            if (box_distance(a, one, one + PLACED_EXTENT, two, two + PLACED_EXTENT) < distance)
                list_append(a, &near, T(I_NEXT_PAIR), pair);
        }
    }
    if (near.last >= 0) I(T(I_NEXT_PAIR) + near.last) = -1;
    ROLLED for (int pair = near.last < 0 ? -1 : near.first; pair >= 0; pair = I(T(I_NEXT_PAIR) + pair))
        touch_pair(a, pair, &list);
    a->num_contacts = number_contacts(a, &list, first);
    ROLLED for (int i = first + a->lane; i < a->num_contacts; i += LANES) build_pair(a, i);
}
#endif
