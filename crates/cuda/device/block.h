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
#endif
