/* Actuator networks: crates/dynamics/src/networks.rs. All robots of a warp follow the same instructions, and
 * read the same weights at the same time. */
#ifndef POLYPOD_NETWORKS_H
#define POLYPOD_NETWORKS_H
#include "tables.h"

/* Joints of a network that a thread computes together: each weight that it reads serves all of them. Where
 * fewer are left, it computes with numbers that nobody reads. */
typedef struct {
    int first, count; /* the first one among those of the network, and how many: each LANES after the other */
    int memory, all;  /* where the memory of the network's instructions begins; joints of the network */
} Share;

/* Joint k of a share, among those of the network. */
#define NUMBER_OF(k) (of->first + (k) * LANES)
/* A feature of the thread's joint k, and a number that the network remembers of it. The threads of a warp
 * have their features side by side. */
#define FEATURE(i, k) (a->w[T(W_FEATURES) * TILE + (((i) * TOGETHER + (k)) * THREADS + a->lane) * TILE])
#define REMEMBERED(i, k) S(of->memory + (i) * of->all + NUMBER_OF(k))
#define EACH_JOINT(k) UNROLLED for (int k = 0; k < TOGETHER; k++)
#define EACH_FEATURE(i, k) ROLLED for (int i = 0; i < len; i++) EACH_JOINT(k)

FN float sigmoid(float x) { return 1.0f / (1.0f + exp_(-x)); }
FN float tanh_(float x) {
    float y = tanh_positive(fabsf(x));
    return x < 0.0f ? -y : y;
}

/* The weights of an input for some outputs, which are four by four in the table. */
FN void load_weights(const Robot *a, int at, float *o) {
#if defined(__CUDACC__) && !defined(POLYPOD_TABLES)
    UNROLLED for (int i = 0; i < OUTPUTS; i += 4) {
        float4 four = READ((const float4 *)(a->c + at + i));
        o[i] = four.x;
        o[i + 1] = four.y;
        o[i + 2] = four.z;
        o[i + 3] = four.w;
    }
#else
    for (int i = 0; i < OUTPUTS; i++) o[i] = LC(at + i);
#endif
}

/* A layer: for OUTPUTS outputs at a time the bias, then the weights of each input. */
FN void affine(Robot *a, int from, int inputs, int to, int len, int at) {
    float sums[TOGETHER][OUTPUTS], weights[OUTPUTS];
    ROLLED for (int first = 0; first < len; first += OUTPUTS) {
        load_weights(a, at, weights);
        EACH_JOINT(k) UNROLLED for (int o = 0; o < OUTPUTS; o++) sums[k][o] = weights[o];
        BY_TWO for (int i = 0; i < inputs; i++) {
            at += OUTPUTS;
            load_weights(a, at, weights);
            EACH_JOINT(k) {
                float x = FEATURE(from + i, k);
                UNROLLED for (int o = 0; o < OUTPUTS; o++) sums[k][o] = fma_(weights[o], x, sums[k][o]);
            }
        }
        at += OUTPUTS;
        UNROLLED for (int o = 0; o < OUTPUTS; o++)
            if (first + o < len) EACH_JOINT(k) FEATURE(to + first + o, k) = sums[k][o];
    }
}

/* The cell of an LSTM: its gates are input, output, forget and candidate. */
FN void cell(Robot *a, const Share *of, int gates, int to, int len, int hidden, int cells) {
    ROLLED for (int i = 0; i < len; i++)
        EACH_JOINT(k) {
            if (k >= of->count) continue;
            float input = FEATURE(gates + i, k), output = FEATURE(gates + len + i, k);
            float forget = FEATURE(gates + 2 * len + i, k), candidate = FEATURE(gates + 3 * len + i, k);
            float c = fma_(sigmoid(forget), REMEMBERED(cells + i, k), sigmoid(input) * tanh_(candidate));
            float h = sigmoid(output) * tanh_(c);
            REMEMBERED(cells + i, k) = c;
            REMEMBERED(hidden + i, k) = h;
            FEATURE(to + i, k) = h;
        }
}

/* Copies features, or one to several places; ranges may overlap. */
FN void copy_features(Robot *a, int from, int to, int len, int step) {
    int back = from < to;
    ROLLED for (int n = 0; n < len; n++) {
        int i = back ? len - 1 - n : n;
        EACH_JOINT(k) FEATURE(to + i, k) = FEATURE(from + i * step, k);
    }
}

FN void follow(Robot *a, const Share *of, int instruction) {
    int from = L(instruction + 1), to = L(instruction + 2), len = L(instruction + 3);
    int more = L(instruction + 4), other = L(instruction + 5), at = L(instruction + 6);
#define FUNCTION(y)                  \
    EACH_FEATURE(i, k) {             \
        float x = FEATURE(from + i, k); \
        FEATURE(to + i, k) = (y);    \
    }                                \
    return
#define OPERATION(z)                                              \
    EACH_FEATURE(i, k) {                                          \
        float x = FEATURE(from + i, k), y = FEATURE(other + i, k); \
        FEATURE(to + i, k) = (z);                                 \
    }                                                             \
    return
    switch (L(instruction)) {
    case NETWORK_CONSTANT: EACH_FEATURE(i, k) FEATURE(to + i, k) = LC(at + i); return;
    case NETWORK_COPY: copy_features(a, from, to, len, more); return;
    case NETWORK_AFFINE: affine(a, from, more, to, len, at); return;
    case NETWORK_RELU: FUNCTION(x < 0.0f ? 0.0f : x);
    case NETWORK_LEAKY_RELU: FUNCTION(x < 0.0f ? LC(at) * x : x);
    case NETWORK_ELU: FUNCTION(x < 0.0f ? LC(at) * (exp_(x) - 1.0f) : x);
    case NETWORK_TANH: FUNCTION(tanh_(x));
    case NETWORK_SIGMOID: FUNCTION(sigmoid(x));
    case NETWORK_SOFTSIGN: FUNCTION(x / (1.0f + fabsf(x)));
    case NETWORK_ABS: FUNCTION(fabsf(x));
    case NETWORK_NEG: FUNCTION(-x);
    case NETWORK_ADD: OPERATION(x + y);
    case NETWORK_SUB: OPERATION(x - y);
    case NETWORK_MUL: OPERATION(x * y);
    case NETWORK_DIV: OPERATION(x / y);
    case NETWORK_RECALL: EACH_FEATURE(i, k) if (k < of->count) FEATURE(to + i, k) = REMEMBERED(more + i, k); return;
    default: cell(a, of, from, to, len, more, other);
    }
#undef FUNCTION
#undef OPERATION
}

/* The same joint, among those of the robot. */
#define JOINT_OF(k) L(L(network + NET_JOINT) + NUMBER_OF(k))
#define POSITION_ERROR(joint) (W(T(W_TARGET) + (joint)) - S(T(S_JOINT) + (joint)))

FN void read_inputs(Robot *a, const Share *of, int network, int errors, int velocities) {
    ROLLED for (int i = 0; i < L(network + NET_INPUTS); i++) {
        int input = L(network + NET_INPUT) + i * NET_INPUT_SIZE, is_velocity = L(input), age = L(input + 1);
        float scale = LC(L(network + NET_NUMBERS) + 1 + i);
        EACH_JOINT(k) {
            if (k >= of->count) continue;
            float x;
            if (age)
                x = S((is_velocity ? velocities : errors) + (age - 1) * of->all + NUMBER_OF(k));
            else
                x = is_velocity ? S(T(S_JOINT_VELOCITY) + JOINT_OF(k)) : POSITION_ERROR(JOINT_OF(k));
            FEATURE(i, k) = x * scale;
        }
    }
}

/* Puts a number in front of those of past physics steps. */
FN void remember(Robot *a, int at, int past, int all, float now) {
    ROLLED for (int i = past - 1; i > 0; i--) S(at + i * all) = S(at + (i - 1) * all);
    if (past > 0) S(at) = now;
}

/* Torques of some joints of a network, and what it remembers of them. Returns 0, or NaN if a torque is not
 * finite. */
FN float drive_joints(Robot *a, const Share *of, int network) {
    int past = L(network + NET_PAST), errors = T(S_MEMORY) + L(network + NET_MEMORY), velocities = errors + past * of->all;
    float unbounded = 0.0f;
    read_inputs(a, of, network, errors, velocities);
    ROLLED for (int i = 0; i < L(network + NET_INSTRUCTIONS); i++)
        follow(a, of, L(network + NET_INSTRUCTION) + i * INSTRUCTION_SIZE);
    EACH_JOINT(k) {
        if (k >= of->count) continue;
        int joint = JOINT_OF(k);
        float effort = FEATURE(L(network + NET_OUTPUT), k) * LC(L(network + NET_NUMBERS));
        W(T(W_DRIVEN) + joint) = effort;
        /* zero times infinity is not zero, nor is anything of NaN */
        unbounded = fma_(effort, 0.0f, unbounded);
        remember(a, errors + NUMBER_OF(k), past, of->all, POSITION_ERROR(joint));
        remember(a, velocities + NUMBER_OF(k), past, of->all, S(T(S_JOINT_VELOCITY) + joint));
    }
    return unbounded;
}

/* Efforts that are added to those of the gains: a caller's, or the torques of networks. A torque that is not
 * finite leaves no finite force on the base, so that the state breaks. */
FN void drive_by_networks(Robot *a, int substep) {
    float unbounded = 0.0f, all_unbounded = 0.0f;
    SHARED_OUT(j, T(JOINTS)) W(T(W_DRIVEN) + j) = D(T(D_FEEDFORWARD) + j);
    SYNC;
    ROLLED for (int n = 0; n < T(NETWORKS); n++) {
        int network = T(T_NETWORK) + n * NETWORK_SIZE, all = L(network), past = L(network + NET_PAST);
        Share of = {a->lane, 0, T(S_MEMORY) + L(network + NET_MEMORY) + 2 * past * all, all};
        ROLLED for (; of.first < all; of.first += TOGETHER * LANES) {
            int left = (all - of.first + LANES - 1) / LANES;
            of.count = left < TOGETHER ? left : TOGETHER;
            unbounded = unbounded + drive_joints(a, &of, network);
        }
        SYNC;
    }
    for (int k = 0; k < LANES; k++) all_unbounded = all_unbounded + FROM_LANE(unbounded, k);
    if (IS_FIRST(a)) W(T(W_UNBOUNDED)) = (substep > 0 ? W(T(W_UNBOUNDED)) : 0.0f) + all_unbounded;
    SYNC;
}
#endif
