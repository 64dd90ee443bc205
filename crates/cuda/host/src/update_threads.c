/* The update with the threads of each block, as a card does, by coroutines: see threads.c. */
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>
#include <ucontext.h>

#define THREADS 128
#define STACK_BYTES (1 << 16)

/* The threads of a block, and what they do. */
static _Thread_local struct {
    jmp_buf scheduler, at[THREADS];
    int thread, begun[THREADS], ended[THREADS];
    void (*work)(const void *job, int block);
    const void *job;
    int block;
} team;

static void meet(void) {
    if (!_setjmp(team.at[team.thread])) _longjmp(team.scheduler, 1);
}

static void run_thread(void) {
    team.work(team.job, team.block);
    team.ended[team.thread] = 1;
    _longjmp(team.scheduler, 1);
}

/* Lets each thread go on to the next meeting. Returns how many have ended. */
static int go_on(ucontext_t *contexts, unsigned order) {
    int ended = 0;
    for (volatile int k = 0; k < THREADS; k++) {
        team.thread = (int)((order >> 8 & 1 ? THREADS - 1 - k : k) + (order >> 16)) % THREADS;
        if (!_setjmp(team.scheduler)) {
            if (team.begun[team.thread]) _longjmp(team.at[team.thread], 1);
            team.begun[team.thread] = 1;
            setcontext(&contexts[team.thread]);
        }
    }
    for (int thread = 0; thread < THREADS; thread++) ended += team.ended[thread];
    return ended;
}

static void run_block(void (*work)(const void *, int), const void *job, int block) {
    static _Thread_local unsigned order = 1;
    static _Thread_local ucontext_t contexts[THREADS];
    static _Thread_local char *stacks;
    if (!stacks && !(stacks = malloc((size_t)THREADS * STACK_BYTES))) abort();
    team.work = work;
    team.job = job;
    team.block = block;
    for (int thread = 0; thread < THREADS; thread++) {
        team.begun[thread] = team.ended[thread] = 0;
        getcontext(&contexts[thread]);
        contexts[thread].uc_stack.ss_sp = stacks + (size_t)thread * STACK_BYTES;
        contexts[thread].uc_stack.ss_size = STACK_BYTES;
        contexts[thread].uc_link = NULL;
        makecontext(&contexts[thread], run_thread, 0);
    }
    int ended = 0;
    while (ended == 0) {
        order = order * 1664525u + 1013904223u;
        ended = go_on(contexts, order);
    }
    if (ended != THREADS) {
        fprintf(stderr, "a thread of a block ends while others wait\n");
        abort();
    }
}

#define EACH_THREAD for (int t = team.thread, once = 1; once; once = 0)
#define OWN 1
#define MINE 0
#define SHARED static _Thread_local FOUR
#define MEET meet()
#define BLOCKS(name, Job)                                                                                  \
    static void name##_work(const void *job, int block) { name##_block((const Job *)job, block); }         \
    void name##_by_threads(const Job *job) {                                                               \
        for (int block = 0; block < job->blocks; block++) run_block(name##_work, job, block);              \
    }
#define BLOCKS_OF_TWO(name, Job)                                                                           \
    static void name##_work(const void *job, int block) { name##_block((const Job *)job, block); }         \
    void name##_by_threads(const Job *jobs) {                                                              \
        for (int y = 0; y < 2; y++)                                                                        \
            for (int block = 0; block < jobs[y].blocks; block++) run_block(name##_work, jobs + y, block);  \
    }
#include "../../device/learn.cu"
