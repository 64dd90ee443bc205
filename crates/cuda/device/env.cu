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
    float *actions;            /* rows on the device: actions, observations, those of episodes that have ended */
    float *observations;
    float *finals;
    float *rewards;
    float *commands;
    unsigned char *terminated; /* how episodes have ended in the control step */
    unsigned char *truncated;
    float *kept;               /* rows of robots that are watched; null if none is */
    const float *given;        /* where the actions come from */
    float *host_observations;  /* where the host has these rows; null if it does not wait for the step */
    float *host_finals;
    float *host_rewards;
    float *host_commands;
    unsigned *flags;           /* what the host is told of each control step */
    unsigned *ended;           /* rows of episodes that have ended */
    int ended_size;
    int warp; /* the first warp of the block's envs */
} EnvBlock;

FN void step_env(const EnvBlock *envs, int e, int after) {
    const Block *block = &envs->block;
    Present present;
    Robot robot, *a = &robot;
    Env env, *v = &env;
    bind_robot(a, block, e, 0, &present);
    v->drive = block->drive + (size_t)e * T(SIZE_DRIVE);
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
    v->kept = envs->kept ? envs->kept + (size_t)e * (2 * size_of_kept(v) + 2 + size_of_body(v)) : envs->kept;
    v->random = (Wide)U(U_STATE + 1) << 32 | U(U_STATE);
    v->increment = (Wide)U(U_INCREMENT + 1) << 32 | U(U_INCREMENT);
    v->flags = U(U_FLAGS);
    if (after) {
        unsigned refused = v->flags & BAD_ACTION;
        v->flags &= ~(unsigned)BAD_ACTION;
        unsigned flags = after_physics(v, e, envs->ended + (size_t)e * envs->ended_size);
        envs->flags[e] = flags | refused;
        envs->rewards[e] = v->total;
        for (int d = 0; d < 3; d++) envs->commands[3 * e + d] = X(K(X_COMMAND) + d);
        envs->terminated[e] = (flags & TERMINATED) != 0;
        envs->truncated[e] = (flags & TRUNCATED) != 0;
        if (envs->host_observations) {
            envs->host_rewards[e] = v->total;
            for (int d = 0; d < 3; d++) envs->host_commands[3 * e + d] = X(K(X_COMMAND) + d);
            if (flags & HAS_FINAL)
                ROLLED for (int i = 0; i < K(K_OBSERVED); i++)
                    envs->host_finals[(size_t)e * K(K_OBSERVED) + i] = v->final[i];
        }
    } else {
        if (!acts_within_bounds(v)) {
            /* the host is told, and the env goes on with a state that is one */
            v->flags |= BAD_ACTION;
            ROLLED for (int i = 0; i < K(K_ACTIONS); i++) envs->actions[(size_t)e * K(K_ACTIONS) + i] = 0.0f;
        }
        before_physics(v);
    }
    U(U_STATE) = (unsigned)v->random;
    U(U_STATE + 1) = (unsigned)(v->random >> 32);
    U(U_FLAGS) = v->flags;
}

/* Neighbouring threads copy neighbouring numbers. */
FN void copy_numbers(float *to, const float *from, int count, int thread, int threads) {
#ifdef __CUDACC__
    _Pragma("unroll 8")
#endif
    for (int k = thread; k < count; k += threads) to[k] = from[k];
}

#ifdef __CUDACC__
/* Each warp takes 32 envs of a block: their actions to where they are kept, and their observations to
 * the host. */
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
        copy_numbers(envs.actions + first_action, envs.given + first_action, present * actions, thread, present);
        __syncwarp(together);
    }
    step_env(&envs, begin + thread, after);
    if (!after || !envs.host_observations) return;
    __syncwarp(together);
    copy_numbers(envs.host_observations + first, envs.observations + first, present * observed, thread, present);
}
#else
void polypod_env_step(const EnvBlock *envs, int after) {
    int actions = READ(envs->task + K_ACTIONS), observed = READ(envs->task + K_OBSERVED);
    for (int e = 0; e < envs->block.robots; e++) {
        size_t first_action = (size_t)e * actions, first = (size_t)e * observed;
        if (!after) copy_numbers(envs->actions + first_action, envs->given + first_action, actions, 0, 1);
        step_env(envs, e, after);
        if (after && envs->host_observations)
            copy_numbers(envs->host_observations + first, envs->observations + first, observed, 0, 1);
    }
}
#endif
