/* Steps robots with LANES threads each, as a card does. The threads are coroutines: one after the
 * other goes on to the next SYNC, in an order that changes from time to time. A number that is read
 * without a SYNC after another thread has written it is another number in some order, and gives other
 * bits. */
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ucontext.h>

#define LANES 4
#define STACK_BYTES (1 << 18)

/* The threads of a robot. */
static _Thread_local struct {
    jmp_buf scheduler, at[LANES];
    int lane, begun[LANES], ended[LANES];
    unsigned number[LANES]; /* what each thread shows to the others */
} team;

static void meet(void) {
    if (!_setjmp(team.at[team.lane])) _longjmp(team.scheduler, 1);
}

static float shared_float(float x, int lane) {
    memcpy(&team.number[team.lane], &x, sizeof x);
    meet();
    memcpy(&x, &team.number[lane], sizeof x);
    meet();
    return x;
}

static int shared_int(int x, int lane) {
    team.number[team.lane] = (unsigned)x;
    meet();
    x = (int)team.number[lane];
    meet();
    return x;
}

#define SYNC meet()
#define GROUP_SYNC(a) meet()
#define GROUP_OF_THREAD 1u
#define FROM_LANE(x, lane) _Generic((x), float: shared_float, int: shared_int)(x, lane)
#define FROM_GROUP(a, x, lane) FROM_LANE(x, lane)
#define polypod_control_step polypod_control_step_by_one_thread
#include "../../device/step.cu"
#undef polypod_control_step

static _Thread_local const Block *stepped;
static _Thread_local int stepped_robot;

static void run_thread(void) {
    step_robot(stepped, stepped_robot, team.lane);
    team.ended[team.lane] = 1;
    _longjmp(team.scheduler, 1);
}

/* Lets each thread go on to the next meeting. Returns how many have ended. */
static int go_on(ucontext_t *contexts, unsigned order) {
    int ended = 0;
    for (volatile int k = 0; k < LANES; k++) {
        team.lane = (int)((order >> 8 & 1 ? LANES - 1 - k : k) + (order >> 16)) % LANES;
        if (!_setjmp(team.scheduler)) {
            if (team.begun[team.lane]) _longjmp(team.at[team.lane], 1);
            team.begun[team.lane] = 1;
            setcontext(&contexts[team.lane]);
        }
    }
    for (int lane = 0; lane < LANES; lane++) ended += team.ended[lane];
    return ended;
}

void polypod_control_step_by_threads(const Block *block) {
    static _Thread_local unsigned order = 1;
    ucontext_t contexts[LANES];
    char *stacks = malloc((size_t)LANES * STACK_BYTES);
    if (!stacks) abort();
    for (volatile int e = 0; e < block->robots; e++) {
        stepped = block;
        stepped_robot = e;
        for (int lane = 0; lane < LANES; lane++) {
            team.begun[lane] = team.ended[lane] = 0;
            getcontext(&contexts[lane]);
            contexts[lane].uc_stack.ss_sp = stacks + (size_t)lane * STACK_BYTES;
            contexts[lane].uc_stack.ss_size = STACK_BYTES;
            contexts[lane].uc_link = NULL;
            makecontext(&contexts[lane], run_thread, 0);
        }
        int ended = 0;
        while (ended == 0) {
            order = order * 1664525u + 1013904223u;
            ended = go_on(contexts, order);
        }
        if (ended != LANES) {
            fprintf(stderr, "a thread of robot %d ends while others wait\n", (int)e);
            abort();
        }
    }
    free(stacks);
}
