/* Steps the robots of blocks, LANES threads per robot. The text is compiled twice: by NVRTC for a GPU,
 * and as C for the host, where a loop stands for the threads. Both give the bits of the scalar
 * kernels of crates/dynamics. */
#include "block.h"
#include "step.h"

FN void step_robot(const Block *block, int e, int lane) {
    Present present;
    Robot robot;
    bind_robot(&robot, block, e, lane, &present);
    control_step(&robot, block->first, block->end, block->capacity);
}

#ifdef __CUDACC__
#define IN_GLOBAL_MEMORY(pointer) __builtin_assume(__isGlobal(pointer))
/* Copies rows: neighbouring threads copy neighbouring numbers. */
FN void copy_rows(float *to, const float *from, int count, int thread, int threads) {
    _Pragma("unroll 8") for (int k = thread; k < count; k += threads) to[k] = from[k];
}

/* Tells the host that all warps of a block have ended, so that it reads their rows while other blocks
 * step. The warp's rows are in the host's memory before it counts itself. */
FN void end_warp(const Block *block, int warps, int thread, unsigned contacts) {
    volatile unsigned *done = block->done;
    if (contacts > 0) atomicMax(block->ended + 1, contacts);
    __threadfence_system();
    __syncwarp();
    if (thread > 0 || atomicAdd(block->ended, 1u) + 1 < (unsigned)warps) return;
    __threadfence();
    block->ended[0] = 0;
    done[1] = atomicExch(block->ended + 1, 0u);
    __threadfence_system();
    done[0] = (unsigned)block->number;
}

/* Each warp takes 32 / LANES robots of a block, and their rows from the host and back. */
KERNEL void polypod_control_step(const Block *blocks, int count) {
    const int robots = 32 / LANES;
    int warp = (int)(blockIdx.x * (blockDim.x / 32) + threadIdx.x / 32), thread = (int)threadIdx.x % 32, b = 0;
    while (b + 1 < count && blocks[b + 1].warp <= warp) b++;
    Block block = blocks[b];
    /* pointers that come from memory: without this, accesses ask where each leads */
    IN_GLOBAL_MEMORY(block.integers);
    IN_GLOBAL_MEMORY(block.numbers);
    IN_GLOBAL_MEMORY(block.parameters);
    IN_GLOBAL_MEMORY(block.common);
    IN_GLOBAL_MEMORY(block.drive);
    IN_GLOBAL_MEMORY(block.state);
    IN_GLOBAL_MEMORY(block.report);
    IN_GLOBAL_MEMORY(block.grid);
    IN_GLOBAL_MEMORY(block.work);
    IN_GLOBAL_MEMORY(block.work_integers);
    Robot tables, *a = &tables;
    a->t = block.integers;
    int begin = (warp - block.warp) * robots, present = block.robots - begin;
    present = present < robots ? present : robots;
    int threads = present * LANES;
    if (thread >= threads) return;
    int drive = T(SIZE_DRIVE), state = T(SIZE_STATE) + LISTED_SIZE * block.capacity, report = T(SIZE_REPORT);
    size_t drives = (size_t)begin * drive, states = (size_t)begin * state, reports = (size_t)begin * report;
    if (block.host) {
        copy_rows(block.drive + drives, block.host + drives, present * drive, thread, threads);
        copy_rows(block.state + states, block.host + (block.state - block.drive) + states, present * state, thread, threads);
        __syncwarp();
    }
    step_robot(&block, begin + thread / LANES, thread % LANES);
    if (block.host) {
        __syncwarp();
        copy_rows(block.host + (block.state - block.drive) + states, block.state + states, present * state, thread, threads);
        copy_rows(block.host + (block.report - block.drive) + reports, block.report + reports, present * report, thread, threads);
        unsigned contacts = thread < present ? (unsigned)block.state[states + thread * state + T(S_PRESSING)] : 0u;
        end_warp(&block, (block.robots + robots - 1) / robots, thread, contacts);
    }
}
#else
void polypod_control_step(const Block *block) {
    for (int e = 0; e < block->robots; e++) step_robot(block, e, 0);
}
#endif
