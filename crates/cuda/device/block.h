/* A block of robots, as kernels get it. */
#ifndef POLYPOD_BLOCK_H
#define POLYPOD_BLOCK_H
#include "tables.h"

typedef struct {
    const int *integers;
    const float *numbers;
    const float *parameters; /* of each robot */
    const float *common;     /* of all robots */
    float *drive; /* rows of the drive, followed by those of the state and of the report */
    float *state;
    float *report;
    float *host; /* where the host has these rows; null if they are in their places */
    const float *grid;
    float *work;
    int *work_integers;
    unsigned *ended; /* warps of the block that have ended, and the most contacts of a robot */
    unsigned *done;  /* where the host reads the number of the last control step that all have ended,
                      * and the most contacts */
    int robots;
    unsigned own; /* a bit for each column of parameters: whether robots read their own */
    int capacity; /* contacts that the state's list has room for */
    int first;    /* physics steps of the control step: first to end */
    int end;
    int warp; /* the first warp that steps robots of the block */
    int number; /* of the control step */
} Block;

/* Where the columns of a robot begin: in its tile, at its place. */
FN size_t place(int e, int size) { return (size_t)(e / TILE) * TILE * size + e % TILE; }

/* Numbers of the present physics step that a thread keeps, see Robot. */
typedef struct {
    float base_rotation[9], bias_base[6], velocity_base[6], g[36], root[12], y[6], moved[6];
} Present;

/* Robot `e` of a block, as one of its threads has it. The pointers are not `restrict`: other threads of
 * the robot write the same memory between two meetings. */
FN void bind_robot(Robot *a, const Block *block, int e, int lane, Present *present) {
    a->lane = lane;
    a->base_rotation = present->base_rotation;
    a->bias_base = present->bias_base;
    a->velocity_base = present->velocity_base;
    a->g = present->g;
    a->root = present->root;
    a->y = present->y;
    a->moved = present->moved;
    a->t = block->integers;
    a->c = block->numbers;
    a->p = block->own ? block->parameters + place(e, T(SIZE_PARAMETERS)) : block->common;
    a->common = block->common;
    a->own = block->own;
    a->d = block->drive + (size_t)e * T(SIZE_DRIVE);
    a->row = block->state + (size_t)e * (T(SIZE_STATE) + LISTED_SIZE * block->capacity);
    a->r = block->report + (size_t)e * T(SIZE_REPORT);
    a->grid = block->grid;
    a->w = block->work + place(e, T(SIZE_WORK));
    a->s = a->w + (size_t)T(W_STATE) * TILE;
    a->wi = block->work_integers + place(e, T(SIZE_WORK_INTEGERS));
}
#endif
