/* Constraint rows Z = H^-T J^T, three at a time: crates/dynamics/src/sparse_rows.rs and rows.rs.
 *
 * `row` is the first column of the rows: their base parts (18), then the parts of the first block of
 * their path (9). `further` is the first column of the parts of the other blocks. With `units` the
 * numbers below the diagonal of the first block's part are zero, and left out. */
#ifndef POLYPOD_ROWS_H
#define POLYPOD_ROWS_H
#include "factor.h"

/* A path: its blocks, where the velocities of the first one are, and the list of its parts. */
typedef struct {
    int parts, place, list;
} Path;

FN Path path_of(const Robot *a, int path) {
    Path o = {PATH_PARTS(path), 0, PATH_FIRST(path)};
    if (o.parts > 0) o.place = BLOCK * L(o.list);
    return o;
}
/* where the velocities of the block of a part are */
#define PLACE(path, p) (BLOCK * L((path).list + (p) * PART_SIZE))

/* Three rows in registers: their base parts, and the parts of the first block of their path. */
typedef struct {
    float base[18], own[9];
} Rows;

FN void load_rows(const Robot *a, int row, Rows *z) {
    w_load(a, row, 18, z->base);
    w_load(a, row + ROW_OWN, 9, z->own);
}

/* Velocities of three rows. */
FN void velocities(const Robot *a, const Rows *z, int further, Path path, int units, const float *y, int joints,
                   float *w) {
    float v[3];
    w_load(a, joints + path.place, 3, v);
    for (int d = 0; d < 3; d++) {
        w[d] = z->own[d] * v[0];
        for (int s = 1; s < BLOCK; s++)
            if (!units || d >= s) w[d] = fma_(z->own[3 * s + d], v[s], w[d]);
    }
    ROLLED for (int p = 1; p < path.parts; p++) {
        int at = further + 9 * (p - 1);
        w_load(a, joints + PLACE(path, p), 3, v);
        for (int d = 0; d < 3; d++)
            for (int s = 0; s < BLOCK; s++) w[d] = fma_(W(at + 3 * s + d), v[s], w[d]);
    }
    for (int d = 0; d < 3; d++) {
        const float *b = z->base + 6 * d;
        float even = fma_(b[4], y[4], fma_(b[2], y[2], fma_(b[0], y[0], w[d])));
        float odd = fma_(b[5], y[5], fma_(b[3], y[3], b[1] * y[1]));
        w[d] = even + odd;
    }
}

/* Adds to a sparse velocity what impulses on three rows change. */
FN void apply_rows(Robot *a, const Rows *z, int further, Path path, int units, const float *impulse, float *y,
                   int joints) {
    for (int r = 0; r < 6; r++) {
        y[r] = fma_(z->base[r], impulse[0], y[r]);
        y[r] = fma_(z->base[6 + r], impulse[1], y[r]);
        y[r] = fma_(z->base[12 + r], impulse[2], y[r]);
    }
    for (int s = 0; s < BLOCK; s++) {
        int at = joints + path.place + s;
        float x = W(at);
        for (int d = 0; d < 3; d++)
            if (!units || d >= s) x = fma_(z->own[3 * s + d], impulse[d], x);
        W(at) = x;
    }
    ROLLED for (int p = 1; p < path.parts; p++) {
        for (int s = 0; s < BLOCK; s++) {
            int at = joints + PLACE(path, p) + s, from = further + 9 * (p - 1) + 3 * s;
            float x = W(at);
            for (int d = 0; d < 3; d++) x = fma_(W(from + d), impulse[d], x);
            W(at) = x;
        }
    }
}

/* a . b + c of six numbers, in two chains */
FN float dot6_onto(const float *a, const float *b, float c) {
    float even = fma_(a[4], b[4], fma_(a[2], b[2], fma_(a[0], b[0], c)));
    float odd = fma_(a[5], b[5], fma_(a[3], b[3], a[1] * b[1]));
    return even + odd;
}

/* Products of the rows 0 0, 1 1, 2 2, 0 1, 0 2, 1 2. */
FN void products(const Robot *a, const float *base, const float *own, int further, int path, int units, float *out) {
    float product[6] = {0}, x[9];
    for (int s = 0; s < BLOCK; s++) {
        const float *z = own + 3 * s;
        if (!units || s <= 0) product[0] = fma_(z[0], z[0], product[0]);
        if (!units || s <= 1) product[1] = fma_(z[1], z[1], product[1]);
        product[2] = fma_(z[2], z[2], product[2]);
        if (!units || s <= 0) product[3] = fma_(z[0], z[1], product[3]);
        if (!units || s <= 0) product[4] = fma_(z[0], z[2], product[4]);
        if (!units || s <= 1) product[5] = fma_(z[1], z[2], product[5]);
    }
    ROLLED for (int p = 1; p < PATH_PARTS(path); p++) {
        w_load(a, further + 9 * (p - 1), 9, x);
        for (int s = 0; s < BLOCK; s++) {
            const float *z = x + 3 * s;
            product[0] = fma_(z[0], z[0], product[0]);
            product[1] = fma_(z[1], z[1], product[1]);
            product[2] = fma_(z[2], z[2], product[2]);
            product[3] = fma_(z[0], z[1], product[3]);
            product[4] = fma_(z[0], z[2], product[4]);
            product[5] = fma_(z[1], z[2], product[5]);
        }
    }
    out[0] = dot6_onto(base, base, product[0]);
    out[1] = dot6_onto(base + 6, base + 6, product[1]);
    out[2] = dot6_onto(base + 12, base + 12, product[2]);
    out[3] = dot6_onto(base, base + 6, product[3]);
    out[4] = dot6_onto(base, base + 12, product[4]);
    out[5] = dot6_onto(base + 6, base + 12, product[5]);
}

/* Velocity of the first of three rows. */
FN float first_velocity(const Robot *a, int row, int further, Path path, const float *y_base, int joints) {
    int at = joints + path.place;
    float base[6], w = W(row + ROW_OWN) * W(at);
    w = fma_(W(row + ROW_OWN + 6), W(at + 2), fma_(W(row + ROW_OWN + 3), W(at + 1), w));
    ROLLED for (int p = 1; p < path.parts; p++) {
        int z = further + 9 * (p - 1);
        at = joints + PLACE(path, p);
        for (int s = 0; s < BLOCK; s++) w = fma_(W(z + 3 * s), W(at + s), w);
    }
    w_load(a, row, 6, base);
    return dot6_onto(base, y_base, w);
}

/* As `apply_rows`, for an impulse on the first row alone. */
FN void apply_first(Robot *a, int row, int further, Path path, float impulse, float *y, int joints) {
    for (int r = 0; r < 6; r++) y[r] = fma_(W(row + r), impulse, y[r]);
    ROLLED for (int p = 0; p < (path.parts > 0 ? path.parts : 1); p++) {
        int z = p == 0 ? row + ROW_OWN : further + 9 * (p - 1), at = joints + (p == 0 ? path.place : PLACE(path, p));
        for (int s = 0; s < BLOCK; s++) W(at + s) = fma_(W(z + 3 * s), impulse, W(at + s));
    }
}

/* Eliminates a block's joints among themselves, in its part of the rows. */
FN void eliminate_inner(const Robot *a, int b, float *x) {
    int inner = FACTOR(b) + FACTOR_INNER;
    float l10 = W(inner), l20 = W(inner + 1), l21 = W(inner + 2);
    for (int d = 0; d < 3; d++) {
        x[3 + d] = nfma(l21, x[6 + d], x[3 + d]);
        x[d] = nfma(l10, x[3 + d], nfma(l20, x[6 + d], x[d]));
    }
}

/* Change of the parts that carry a block by the elimination of its joints, whose rows are `x`. */
FN void pass_on(Robot *a, int part, const float *x, int further) {
    int first = L(BLOCK_AT(L(part)) + 6);
    ROLLED for (int c = 0; c < L(part + 2); c++) {
        int on = further + 9 * (L(L(part + 3) + c) - 1);
        float l[9], to[9];
        w_load(a, COUPLING(first + c), 9, l);
        w_load(a, on, 9, to);
        for (int s = 0; s < BLOCK; s++)
            for (int t = 0; t < BLOCK; t++)
                for (int d = 0; d < 3; d++) to[3 * t + d] = nfma(l[3 * s + t], x[3 * s + d], to[3 * t + d]);
        w_store(a, on, 9, to);
    }
}

/* Eliminates the blocks of a path after the first among themselves. */
FN void half_solve_further(Robot *a, int path, int further) {
    ROLLED for (int p = 1; p < PATH_PARTS(path); p++) {
        int part = PART(path, p), at = further + 9 * (p - 1);
        float x[9];
        w_load(a, at, 9, x);
        eliminate_inner(a, L(part), x);
        w_store(a, at, 9, x);
        pass_on(a, part, x, further);
    }
}

FN void eliminate_base(const Robot *a, int b, const float *x, int d, float *base) {
    for (int s = BLOCK - 1; s >= 0; s--)
        for (int r = 0; r < 6; r++) base[r] = nfma(W(FACTOR(b) + FACTOR_BASE + 6 * s + r), x[3 * s + d], base[r]);
}

FN void scale_rows(const Robot *a, int b, float *x) {
    for (int s = 0; s < BLOCK; s++)
        for (int d = 0; d < 3; d++) x[3 * s + d] = x[3 * s + d] * W(ROOT(b) + 2 * s + 1);
}

/* Change of the base's part by the elimination of the joints; D^-1/2 of the blocks after the first. */
FN void solve_base(Robot *a, float *base, const float *own, int further, int path, int with_first) {
    int parts = PATH_PARTS(path);
    float x[9];
    if (T(FLOATING) && with_first)
        for (int d = 0; d < 3; d++) eliminate_base(a, L(PART(path, 0)), own, d, base + 6 * d);
    ROLLED for (int p = 1; p < parts; p++) {
        int b = L(PART(path, p));
        w_load(a, further + 9 * (p - 1), 9, x);
        if (T(FLOATING))
            for (int d = 0; d < 3; d++) eliminate_base(a, b, x, d, base + 6 * d);
        scale_rows(a, b, x);
        w_store(a, further + 9 * (p - 1), 9, x);
    }
    if (!T(FLOATING)) return;
    for (int d = 0; d < 3; d++) {
        base_forward(a, base + 6 * d);
        for (int r = 0; r < 6; r++) base[6 * d + r] = base[6 * d + r] * a->root[2 * r + 1];
    }
}

/* H^-T J^T in place. */
FN void half_solve_rows(Robot *a, float *base, float *own, int further, int path) {
    int parts = PATH_PARTS(path);
    if (parts == 0) {
        solve_base(a, base, own, further, path, 0);
        return;
    }
    int part = PART(path, 0), b = L(part);
    eliminate_inner(a, b, own);
    if (parts > 1) pass_on(a, part, own, further);
    half_solve_further(a, path, further);
    solve_base(a, base, own, further, path, 1);
    scale_rows(a, b, own);
}

/* H^-T J^T of three unit vectors, one for each joint of the block where the path begins. */
FN void half_solve_units(Robot *a, float *base, float *z, int further, int path) {
    int parts = PATH_PARTS(path), part = PART(path, 0), b = L(part), own = FACTOR(b);
    float l10 = W(own + FACTOR_INNER), l20 = W(own + FACTOR_INNER + 1), l21 = W(own + FACTOR_INNER + 2);
    float x01 = -l10, x12 = -l21, x02 = nfma(l10, x12, -l20);
    if (parts > 1) {
        float x[9] = {1.0f, x01, x02, 0.0f, 1.0f, x12, 0.0f, 0.0f, 1.0f};
        ROLLED for (int k = 0; k < 9 * (parts - 1); k++) W(further + k) = 0.0f;
        pass_on(a, part, x, further);
    }
    half_solve_further(a, path, further);
    for (int r = 0; r < 6; r++) {
        float first = W(own + FACTOR_BASE + r), second = W(own + FACTOR_BASE + 6 + r);
        base[r] = -first;
        base[6 + r] = nfma(x01, first, -second);
        base[12 + r] = nfma(x02, first, nfma(x12, second, -W(own + FACTOR_BASE + 12 + r)));
    }
    solve_base(a, base, 0, further, path, 0);
    float r0 = W(ROOT(b) + 1), r1 = W(ROOT(b) + 3), r2 = W(ROOT(b) + 5);
    set3(z, r0, x01 * r0, x02 * r0);
    set3(z + 3, 0.0f, r1, x12 * r1);
    set3(z + 6, 0.0f, 0.0f, r2);
}

/* J of a block's joints for forces along three directions, each its moment and itself. */
FN void joint_rows(const Robot *a, int part, const float *directions, float *out) {
    int joints = BLOCK_AT(L(part));
    for (int s = 0; s < BLOCK; s++) {
        set3(out + 3 * s, 0.0f, 0.0f, 0.0f);
        if (s >= L(part + 1)) continue;
        float axis[6];
        w_load(a, LINK(L(joints + s) + 1) + LINK_AXIS, 6, axis);
        for (int d = 0; d < 3; d++)
            out[3 * s + d] = dot(axis, directions + 6 * d) + dot(axis + 3, directions + 6 * d + 3);
    }
}

/* Z of three rows that act on a link; `base` holds the directions. */
FN void build_rows(Robot *a, int path, float *base, float *own, int further) {
    int parts = PATH_PARTS(path);
    float x[9];
    for (int k = 0; k < 9; k++) own[k] = 0.0f;
    if (parts > 0) joint_rows(a, PART(path, 0), base, own);
    ROLLED for (int p = 1; p < parts; p++) {
        joint_rows(a, PART(path, p), base, x);
        w_store(a, further + 9 * (p - 1), 9, x);
    }
    if (!T(FLOATING))
        for (int k = 0; k < 18; k++) base[k] = 0.0f;
    half_solve_rows(a, base, own, further, path);
}

/* Directions of rows along the axes of `frame` at a point. */
FN void set_directions(const float *point, const float *frame, float *base) {
    for (int d = 0; d < 3; d++) {
        cross(point, frame + 3 * d, base + 6 * d);
        copy(base + 6 * d + 3, frame + 3 * d, 3);
    }
}

#define ROW(i) (T(W_ROW) + (i) * ROW_SIZE)
#define ROW_PARTS(i) (T(W_FURTHER) + (i) * 9 * T(STRIDE))
#define ROW_CONTACT(i) I(T(I_ROW) + ROW_INTEGERS * (i))
#define ROW_PATH(i) I(T(I_ROW) + ROW_INTEGERS * (i) + 1)
#define ROW_PAIR(i) I(T(I_ROW) + ROW_INTEGERS * (i) + 2)
#define ROW_WAY(i) (T(I_ROW) + ROW_INTEGERS * (i) + 3)
#define SPIN(i) (T(W_SPIN) + (i) * SPIN_SIZE)
#define SPIN_PARTS(i) (T(W_SPIN_FURTHER) + (i) * 9 * T(STRIDE))
#define BOUND(b) (T(W_BOUND) + (b) * BOUND_SIZE)
#define BOUND_PARTS(b) (T(W_BOUND_FURTHER) + (b) * 9 * T(STRIDE))
#define BOUND_INTEGER(b) (T(I_BOUND) + (b) * BOUND_INTEGERS)
/* the path of a block's last joint */
#define BOUND_PATH(b) (L(BLOCK_AT(b) + L(BLOCK_AT(b) + 3) - 1) + 1)

/* Keeps the path of contact i where the solver finds it. */
FN void keep_path(Robot *a, int i, int path) {
    Path way = path_of(a, path);
    ROW_PATH(i) = path;
    I(ROW_WAY(i)) = way.parts;
    I(ROW_WAY(i) + 1) = way.place;
    I(ROW_WAY(i) + 2) = way.list;
}
FN Path path_of_row(const Robot *a, int i) {
    Path o = {I(ROW_WAY(i)), I(ROW_WAY(i) + 1), I(ROW_WAY(i) + 2)};
    return o;
}
FN Path path_of_bound(const Robot *a, int b) {
    Path o = {I(BOUND_INTEGER(b) + 8), BLOCK * b, I(BOUND_INTEGER(b) + 9)};
    return o;
}

/* Stores the rows of contact i and their couplings. */
FN void finish_rows(Robot *a, int i, const float *base, const float *own, float compliance) {
    int row = ROW(i);
    float product[6], softness = a->compliance * compliance, least = a->compliance * TC(MIN_TANGENT_COMPLIANCE);
    products(a, base, own, ROW_PARTS(i), ROW_PATH(i), 0, product);
    w_store(a, row, 18, base);
    w_store(a, row + ROW_OWN, 9, own);
    float difference = (product[1] - product[2]) * 0.5f;
    float radius = sqrtf(fma_(difference, difference, product[5] * product[5]));
    float diagonal = product[0] + softness;
    float inverse[3] = {1.0f / diagonal, 1.0f / max_(product[1], least), 1.0f / max_(product[2], least)};
    float c01 = product[3], c02 = product[4], c12 = product[5], pass1 = c01 * inverse[1];
    w_store(a, row + ROW_COUPLING, 3, product + 3);
    w_store(a, row + ROW_INVERSE, 3, inverse);
    w_store(a, row + ROW_ACROSS, 2, product + 1);
    W(row + ROW_DIAGONAL) = diagonal;
    W(row + ROW_STICKING) = pass1;
    W(row + ROW_STICKING + 1) = nfma(c12, pass1, c02) * inverse[2];
    W(row + ROW_STICKING + 2) = c12 * inverse[1] * inverse[2];
    W(row + ROW_SLIDE) = 1.0f / max_(fma_(product[1] + product[2], 0.5f, radius), least);
    W(row + ROW_SOFTNESS) = softness;
}

/* Writes the impulse of a contact in the last physics step, zero if it was not there, from column
 * `at` of the workspace on. */
FN void last_impulse(Robot *a, int contact, int at) {
    int list = T(I_PRESSING), found = -1;
    ROLLED for (int i = 0; i < I(list); i++)
        if (I(list + 1 + i) == contact) found = i;
    for (int d = 0; d < 3; d++) W(at + d) = found < 0 ? 0.0f : W(T(W_PRESSING) + 3 * found + d);
}

/* Makes the rows that were built those of a contact that separates at least at the speeds `target`,
 * which may push out, and `bounce`. */
FN void add_contact(Robot *a, int i, float target, float bounce) {
    int row = ROW(i);
    a->violation = max_(a->violation, target);
    W(row + ROW_TARGET) = max_(min_(target, 0.0f), bounce);
    W(row + ROW_PUSH) = target;
    W(row + ROW_PUSH_IMPULSE) = 0.0f;
    W(row + ROW_LAST_CHANGE) = 0.0f;
    last_impulse(a, ROW_CONTACT(i), row + ROW_IMPULSE);
}

/* Found contacts of a thread: a list in rising order, each with the next one. */
typedef struct {
    int first, last;
} List;
#define FOUND(contact) (T(W_FOUND) + (contact) * FOUND_SIZE)

FN void list_append(Robot *a, List *list, int next, int entry) {
    if (list->last < 0)
        list->first = entry;
    else
        I(next + list->last) = entry;
    list->last = entry;
}

/* Gives the contacts that the threads of a robot found rows in rising order, behind `count` earlier
 * ones. Returns their number. */
FN int number_contacts(Robot *a, List *list, int count) {
    int next[LANES], end = T(ROWS), merged = count;
    if (list->last >= 0) I(T(I_NEXT) + list->last) = end;
    SYNC;
    for (int k = 0; k < LANES; k++) next[k] = FROM_LANE(list->last < 0 ? end : list->first, k);
    ROLLED for (;;) {
        int least = next[0];
        for (int k = 1; k < LANES; k++) least = next[k] < least ? next[k] : least;
        if (least == end) break;
        for (int k = 0; k < LANES; k++) {
            if (next[k] != least) continue;
            next[k] = I(T(I_NEXT) + least);
            if (a->lane == k) ROW_CONTACT(merged) = least;
        }
        merged++;
    }
    SYNC;
    return merged;
}

/* The largest violation that the threads of a robot met. */
FN void share_violation(Robot *a) {
    float own = a->violation;
    for (int k = 0; k < LANES; k++) a->violation = max_(a->violation, FROM_LANE(own, k));
}
#endif
