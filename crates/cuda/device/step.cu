/* Steps the robots of a block, one thread per robot. The text is compiled twice: by NVRTC for a GPU,
 * and as C for the host, where a loop stands for the threads. Both give the bits of the scalar
 * kernels of crates/dynamics. */
#include "step.h"

typedef struct {
    const int *integers;
    const float *numbers;
    const float *parameters;
    const float *drive;
    float *state;
    float *report;
    const float *grid;
    float *work;
    int *work_integers;
    int robots;
    int shared;   /* whether all robots read one list of parameters */
    int capacity; /* contacts that the state's list has room for */
    int first;    /* physics steps of the control step: first to end */
    int end;
} Block;

/* Where the columns of a robot begin: in its tile, at its place. */
FN size_t place(int e, int size) { return (size_t)(e / TILE) * TILE * size + e % TILE; }

FN void step_robot(const Block *block, int e) {
    Robot robot, *a = &robot;
    a->t = block->integers;
    a->c = block->numbers;
    a->p = block->parameters + (block->shared ? 0 : place(e, T(SIZE_PARAMETERS)));
    a->ps = block->shared ? 1 : TILE;
    a->d = block->drive + place(e, T(SIZE_DRIVE));
    a->s = block->state + place(e, T(SIZE_STATE) + LISTED_SIZE * block->capacity);
    a->r = block->report + place(e, T(SIZE_REPORT));
    a->grid = block->grid;
    a->w = block->work + place(e, T(SIZE_WORK));
    a->wi = block->work_integers + place(e, T(SIZE_WORK_INTEGERS));
    take_pressing(a, block->capacity);
    control_step(a, block->first, block->end);
    list_pressing(a, block->capacity);
}

#ifdef __CUDACC__
KERNEL void polypod_control_step(Block block) {
    int e = (int)(blockIdx.x * blockDim.x + threadIdx.x);
    if (e < block.robots) step_robot(&block, e);
}
#else
void polypod_control_step(const Block *block) {
    for (int e = 0; e < block->robots; e++) step_robot(block, e);
}
#endif
