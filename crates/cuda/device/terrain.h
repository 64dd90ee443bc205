/* The height of the ground where it is not a plane: crates/dynamics/src/terrain.rs and ground.rs. */
#ifndef POLYPOD_TERRAIN_H
#define POLYPOD_TERRAIN_H
#include "tables.h"

/* the steepest slope that a contact feels; see crates/dynamics/src/settings.rs */
#define MAX_SLOPE 10.0f
#define MIN_DROP ((float)1e-3)
/* from this number on a float has no digits after the point */
#define WHOLE 8388608.0f

FN float not_below_zero(float x) { return x > 0.0f ? x : 0.0f; }
FN float floor_(float x) {
    float nearest = (x + WHOLE) - WHOLE;
    return nearest > x ? nearest - 1.0f : nearest;
}

/* Heights below a place, rises from one point to the next along x and y, where in its cell the place
 * is, and the heights of the cell's corners. */
typedef struct {
    float height, along_x, along_y, u, v, a, b, c, d;
} Sample;

/* The cell of a coordinate in cells, and where in it; the first cell for a NaN. */
FN int split_place(float x, int points, float *within) {
    x = not_below_zero(x);
    x = x < (float)(points - 1) ? x : (float)(points - 1);
    float i = floor_(x);
    i = i < (float)(points - 2) ? i : (float)(points - 2);
    *within = x - i;
    return (int)i;
}

FN void terrain_sample(const Robot *a, float x, float y, Sample *o) {
    int columns = L(GRID_SIZE + 1);
    x = x + D(T(D_ORIGIN));
    y = y + D(T(D_ORIGIN) + 1);
    int i = split_place((x - TC(GRID_ORIGIN)) / TC(GRID_CELL), T(GRID_SIZE), &o->u);
    int j = split_place((y - C(GRID_ORIGIN + 1)[0]) / TC(GRID_CELL), columns, &o->v);
    const float *cell = a->grid + (size_t)i * columns + j;
    o->a = cell[0];
    o->b = cell[1];
    o->c = cell[columns];
    o->d = cell[columns + 1];
    int first = o->u > o->v;
    o->along_x = first ? o->c - o->a : o->d - o->b;
    o->along_y = first ? o->d - o->c : o->b - o->a;
    o->height = o->a + o->along_x * o->u + o->along_y * o->v;
}

/* The cell of a coordinate. */
FN int cell_of(const Robot *a, float x, int axis) {
    float within;
    return split_place((x - C(GRID_ORIGIN + axis)[0]) / TC(GRID_CELL), L(GRID_SIZE + axis), &within);
}

/* The largest height of the points within a square about a place of the grid, m. */
FN float highest_near(const Robot *a, float x, float y, float half) {
    int last = cell_of(a, x + half, 0) + 1, begin = cell_of(a, y - half, 1), end = cell_of(a, y + half, 1) + 2;
    float highest = -3.40282347e38f;
    ROLLED for (int i = cell_of(a, x - half, 0); i <= last; i++) {
        const float *row = a->grid + (size_t)i * L(GRID_SIZE + 1);
        BY_EIGHT for (int j = begin; j < end; j++) {
            float height = READ(row + j);
            highest = height > highest ? height : highest;
        }
    }
    return highest;
}

FN float slope_of(const Robot *a, float rise) {
    float slope = rise / TC(GRID_CELL);
    if (slope < -MAX_SLOPE) slope = -MAX_SLOPE;
    if (slope > MAX_SLOPE) slope = MAX_SLOPE;
    return slope;
}

/* Gap of a sphere above the ground, m, and the unit normal of the contact; `place` is about the env's
 * origin. On the edge of a step the normal turns as the foot leaves it. */
FN float terrain_gap(const Robot *a, const float *place, float radius, float *normal) {
    Sample found, below;
    terrain_sample(a, place[0], place[1], &found);
    float sx = slope_of(a, found.along_x), sy = slope_of(a, found.along_y);
    float up = 1.0f / sqrtf(fma_(sx, sx, fma_(sy, sy, 1.0f)));
    set3(normal, -(sx * up), -(sy * up), up);
    float distance = (place[2] - found.height) * up, along = distance * TC(GRID_INVERSE_CELL);
    float at0 = nfma(normal[0], along, found.u), at1 = nfma(normal[1], along, found.v);
    float in0 = clamp_(at0, 0.0f, 1.0f), in1 = clamp_(at1, 0.0f, 1.0f);
    float off = max_(fabsf(in0 - at0), fabsf(in1 - at1));
    if (!(0.0f < off && 0.0f < distance && 0.0f < radius)) return distance - radius;
    float foot[3] = {nfma(normal[0], distance, place[0]), nfma(normal[1], distance, place[1]),
                     nfma(normal[2], distance, place[2])};
    terrain_sample(a, foot[0], foot[1], &below);
    if (!(below.height + MIN_DROP < foot[2])) return distance - radius;
    /* the point of the cell that is nearest to there, on one of its sides */
    int first = in1 < in0;
    float along_x = first ? found.c - found.a : found.d - found.b;
    float along_y = first ? found.d - found.c : found.b - found.a;
    float height = fma_(along_x, in0, fma_(along_y, in1, found.a)), cell = TC(GRID_CELL);
    float from[3] = {(found.u - in0) * cell, (found.v - in1) * cell, place[2] - height};
    float squared = fma_(from[0], from[0], fma_(from[1], from[1], from[2] * from[2]));
    float length = sqrtf(max_(squared, (float)1e-12)), inverse = 1.0f / length;
    if (!(length * (float)(1.0 / 10.0) < from[2])) return distance - radius;
    scale(from, inverse, normal);
    return length - radius;
}

FN int square_of(const Robot *a, int squares, float x, int axis) {
    float points = not_below_zero((x - C(GRID_ORIGIN + axis)[0]) / TC(GRID_CELL));
    float last = (float)(L(GRID_SIZE + axis) - 1);
    float square = floor_((points < last ? points : last) / (float)L(squares));
    last = (float)(L(squares + 1 + axis) - 1);
    return (int)(square < last ? square : last);
}

/* No height within `reach` of a place of the env is larger than this, m: of links (0), candidates (1). */
FN float terrain_bound(const Robot *a, int near, float x, float y, float reach) {
    int squares = GRID_SQUARES + 4 * near;
    float far = ((float)L(squares) - 1.0f) * TC(GRID_CELL);
    if (reach > far) return TC(GRID_HIGHEST);
    x = x + D(T(D_ORIGIN));
    y = y + D(T(D_ORIGIN) + 1);
    return a->grid[L(squares + 3) + square_of(a, squares, x, 0) * L(squares + 2) + square_of(a, squares, y, 1)];
}

/* World position of a point in base axes; `level` holds the world's z, x and y in base axes. */
FN void world_place(const float *level, const float *position, const float *place, float *o) {
    float x = dot(level + 3, place), y = dot(level + 6, place), z = dot(level, place);
    set3(o, position[0] + x, position[1] + y, position[2] + z);
}

/* Turns a vector from world axes into base axes. */
FN void to_base(const float *level, const float *v, float *o) {
    float t[3];
    scale(level, v[2], t);
    add_scaled(t, level + 3, v[0], t);
    add_scaled(t, level + 6, v[1], o);
}

/* Gap of a sphere at a world position above the terrain, and normal and tangents there in base axes. */
FN float on_terrain(const Robot *a, const float *level, const float *place, float radius, float *frame) {
    float n[3], along[3], tangent[3], gap = terrain_gap(a, place, radius, n);
    set3(along, nfma(n[0], n[0], 1.0f), -(n[0] * n[1]), -(n[0] * n[2]));
    scale(along, 1.0f / sqrtf(along[0]), tangent);
    to_base(level, n, frame);
    to_base(level, tangent, frame + 3);
    cross(frame, frame + 3, frame + 6);
    return gap;
}
#endif
