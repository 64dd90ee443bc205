/* Steps the robots of a block, one thread per robot. The text is compiled twice: by NVRTC for a GPU,
 * and as C for the host, where a loop stands for the threads. Both give the bits of the scalar
 * kernels of crates/dynamics. */
#include "step.h"

typedef struct {
    const int *integers;
    const float *numbers;
    const float *parameters;
    float *state;
    const float *drive;
    const float *grid;
    float *report;
    int *touched;
    float *work;
    int *work_integers;
    int robots;
    int shared; /* whether all robots read one list of parameters */
    int first;  /* physics steps of the control step: first to end */
    int end;
} Block;

FN void step_robot(const Block *block, size_t e) {
    Robot robot, *a = &robot;
    a->n = (size_t)block->robots;
    a->t = block->integers;
    a->c = block->numbers;
    a->p = block->shared ? block->parameters : block->parameters + e;
    a->ps = block->shared ? 1 : a->n;
    a->s = block->state + e;
    a->d = block->drive + e;
    a->grid = block->grid;
    a->r = block->report + e;
    a->ri = block->touched + e;
    a->w = block->work + e;
    a->wi = block->work_integers + e;
    control_step(a, block->first, block->end);
}

#ifdef __CUDACC__
KERNEL void polypod_control_step(Block block) {
    size_t e = (size_t)blockIdx.x * blockDim.x + threadIdx.x;
    if (e < (size_t)block.robots) step_robot(&block, e);
}
#else
void polypod_control_step(const Block *block) {
    for (int e = 0; e < block->robots; e++) step_robot(block, (size_t)e);
}
#endif
