/* Control steps of envs but for their physics, one thread per env: before it, and after it. The text is
 * compiled twice, as step.cu is. */
#include "block.h"
#include "env.h"

typedef struct {
    Block block;
    const int *task;           /* the task's tables */
    const float *task_numbers;
    float *columns;            /* of the envs: [number][env] */
    unsigned *words;
    float *actions;            /* rows: actions, observations, those of episodes that have ended */
    float *observations;
    float *finals;
    float *kept;               /* rows of robots that are watched; null if none is */
    const float *host_actions; /* where the host has these rows, and what else it reads */
    float *host_observations;
    float *host_finals;
    float *rewards;
    float *commands;
    unsigned *flags;
    unsigned *ended;           /* rows of episodes that have ended */
    int ended_size;
    int warp; /* the first warp of the block's envs */
} EnvBlock;

FN void step_env(const EnvBlock *envs, int e, int after) {
    const Block *block = &envs->block;
    float base_rotation[9], bias_base[6], velocity_base[6], g[36], root[12], y[6], moved[6];
    Robot robot, *a = &robot;
    Env env, *v = &env;
    a->lane = 0;
    a->base_rotation = base_rotation;
    a->bias_base = bias_base;
    a->velocity_base = velocity_base;
    a->g = g;
    a->root = root;
    a->y = y;
    a->moved = moved;
    a->t = block->integers;
    a->c = block->numbers;
    a->p = block->own ? block->parameters + place(e, T(SIZE_PARAMETERS)) : block->common;
    a->common = block->common;
    a->own = block->own;
    a->row = block->state + (size_t)e * (T(SIZE_STATE) + LISTED_SIZE * block->capacity);
    a->r = block->report + (size_t)e * T(SIZE_REPORT);
    a->grid = block->grid;
    a->w = block->work + place(e, T(SIZE_WORK));
    a->s = a->w + (size_t)T(W_STATE) * TILE;
    a->wi = block->work_integers + place(e, T(SIZE_WORK_INTEGERS));
    v->drive = block->drive + (size_t)e * T(SIZE_DRIVE);
    a->d = v->drive;
    v->a = a;
    v->k = envs->task;
    v->f = envs->task_numbers;
    v->x = envs->columns + e;
    v->u = envs->words + e;
    v->envs = (size_t)block->robots;
    v->action = envs->actions + (size_t)e * K(K_ACTIONS);
    v->observation = envs->observations + (size_t)e * K(K_OBSERVED);
    v->final = envs->finals + (size_t)e * K(K_OBSERVED);
    v->row = T(SIZE_STATE) + LISTED_SIZE * block->capacity;
    v->kept = envs->kept ? envs->kept + (size_t)e * (2 * size_of_kept(v) + 1) : envs->kept;
    v->random = (Wide)U(U_STATE + 1) << 32 | U(U_STATE);
    v->increment = (Wide)U(U_INCREMENT + 1) << 32 | U(U_INCREMENT);
    v->flags = U(U_FLAGS);
    if (after) {
        unsigned flags = after_physics(v, e, envs->ended + (size_t)e * envs->ended_size);
        envs->flags[e] = flags;
        envs->rewards[e] = v->total;
        for (int d = 0; d < 3; d++) envs->commands[3 * e + d] = X(K(X_COMMAND) + d);
        if (flags & HAS_FINAL)
            ROLLED for (int i = 0; i < K(K_OBSERVED); i++)
                envs->host_finals[(size_t)e * K(K_OBSERVED) + i] = v->final[i];
    } else {
        before_physics(v);
    }
    U(U_STATE) = (unsigned)v->random;
    U(U_STATE + 1) = (unsigned)(v->random >> 32);
    U(U_FLAGS) = v->flags;
}

#ifdef __CUDACC__
/* Neighbouring threads copy neighbouring numbers. */
FN void copy_numbers(float *to, const float *from, int count, int thread, int threads) {
    _Pragma("unroll 8") for (int k = thread; k < count; k += threads) to[k] = from[k];
}

/* Each warp takes 32 envs of a block: their actions from the host, and their observations there. */
KERNEL void polypod_env_step(const EnvBlock *blocks, int count, int after) {
    int warp = (int)(blockIdx.x * (blockDim.x / WARP) + threadIdx.x / WARP), thread = (int)threadIdx.x % WARP, b = 0;
    while (b + 1 < count && blocks[b + 1].warp <= warp) b++;
    EnvBlock envs = blocks[b];
    int begin = (warp - envs.warp) * WARP, present = envs.block.robots - begin;
    present = present < WARP ? present : WARP;
    if (thread >= present) return;
    unsigned together = present == WARP ? ~0u : (1u << present) - 1u;
    int actions = READ(envs.task + K_ACTIONS), observed = READ(envs.task + K_OBSERVED);
    size_t first_action = (size_t)begin * actions, first = (size_t)begin * observed;
    if (!after) {
        copy_numbers(envs.actions + first_action, envs.host_actions + first_action, present * actions, thread, present);
        __syncwarp(together);
    }
    step_env(&envs, begin + thread, after);
    if (!after) return;
    __syncwarp(together);
    copy_numbers(envs.host_observations + first, envs.observations + first, present * observed, thread, present);
}
#else
void polypod_env_step(const EnvBlock *envs, int after) {
    for (int e = 0; e < envs->block.robots; e++) step_env(envs, e, after);
}
#endif
