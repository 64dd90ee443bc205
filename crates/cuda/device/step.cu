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

/* The columns of a robot do not overlap: a compiler may read one before it has written another. */
FN void step_columns(const Block *block, const float *p, int ps, const float *d, float *RESTRICT s, float *RESTRICT r,
                     float *RESTRICT w, int *RESTRICT wi) {
    float base_rotation[9], bias_base[6], velocity_base[6], g[36], root[12], y[6], moved[6];
    Robot robot, *a = &robot;
    a->base_rotation = base_rotation;
    a->bias_base = bias_base;
    a->velocity_base = velocity_base;
    a->g = g;
    a->root = root;
    a->y = y;
    a->moved = moved;
    a->t = block->integers;
    a->c = block->numbers;
    a->p = p;
    a->ps = ps;
    a->d = d;
    a->s = s;
    a->r = r;
    a->grid = block->grid;
    a->w = w;
    a->wi = wi;
    take_pressing(a, block->capacity);
    control_step(a, block->first, block->end);
    list_pressing(a, block->capacity);
}

FN void step_robot(const Block *block, int e) {
    Robot tables, *a = &tables;
    a->t = block->integers;
    step_columns(block, block->parameters + (block->shared ? 0 : place(e, T(SIZE_PARAMETERS))),
                 block->shared ? 1 : TILE, block->drive + place(e, T(SIZE_DRIVE)),
                 block->state + place(e, T(SIZE_STATE) + LISTED_SIZE * block->capacity),
                 block->report + place(e, T(SIZE_REPORT)), block->work + place(e, T(SIZE_WORK)),
                 block->work_integers + place(e, T(SIZE_WORK_INTEGERS)));
}

#ifdef __CUDACC__
/* Where there are more warps than tiles, each takes fewer robots: those of a warp wait for each other. */
KERNEL void polypod_control_step(Block block) {
    int thread = (int)(blockIdx.x * blockDim.x + threadIdx.x), warps = (int)(gridDim.x * blockDim.x) / TILE, lanes = TILE;
    while (lanes > LEAST_LANES && warps * (lanes / 2) >= block.robots) lanes /= 2;
    int lane = thread % TILE, e = thread / TILE * lanes + lane;
    if (lane < lanes && e < block.robots) step_robot(&block, e);
}
#else
void polypod_control_step(const Block *block) {
    for (int e = 0; e < block->robots; e++) step_robot(block, e);
}
#endif
