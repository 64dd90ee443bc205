/* The update of PPO for two perceptrons: gradients of a mini-batch, their sum over parts of the envs, and
 * a step of Adam. The text is compiled twice, as step.cu is, and has the bits of crates/learner.
 *
 * Weights are stored as there: panels [outputs / 16][inputs, then the bias] of lines of 16 numbers.
 * Activations are rows, [row][numbers, rounded up to lines]. The rows of a part follow one another: the
 * samples of its share of the mini-batch in their order, then their mirror images, each rounded up to
 * DEPTH with rows of zeros. A sum over rows or inputs is one chain in their order, so a thread makes
 * whole chains, and neither tiles nor blocks change a bit. */
#include "numbers.h"

/* threads of a block of each kernel */
#ifndef THREADS
#define THREADS 128
#endif
/* numbers of a line */
#define LINE 16
/* A block of a product has TILE rows and TILE columns, a thread 8 rows and 4 columns of it. DEPTH steps
 * of the inner dimension are in shared memory at a time; inner dimensions and rows are multiples. */
#define TILE 64
#define DEPTH 8
/* numbers of a row of a tile in shared memory, so that threads store to different banks */
#define PITCH 68
/* lines whose squares one block sums, as in update.rs */
#define CHUNK (256 * LINE)
/* sums of a tree over at most 32 parts that wait at a time */
#define WAITING 8

#ifdef __CUDACC__
#define FOUR __align__(16)
/* Work of the threads of a block up to the next MEET. A loop may stand for the threads: so numbers that a
 * thread keeps beyond have a place MINE of OWN. host/src/update_threads.c defines these for coroutines. */
#define EACH_THREAD for (int t = (int)threadIdx.x, once = 1; once; once = 0)
#define OWN 1
#define MINE 0
#define SHARED __shared__ __align__(16)
#define MEET __syncthreads()
/* A kernel whose blocks each do `name_block`, and one whose blocks (x, y) have the y-th of two jobs. */
#define BLOCKS(name, Job)                                                             \
    KERNEL void __launch_bounds__(THREADS) name(const Job job) { name##_block(&job, (int)blockIdx.x); }
#define BLOCKS_OF_TWO(name, Job)                                                      \
    typedef struct { Job of[2]; } Job##s;                                             \
    KERNEL void __launch_bounds__(THREADS) name(const Job##s jobs) {                  \
        Job job = blockIdx.y ? jobs.of[1] : jobs.of[0];                               \
        if ((int)blockIdx.x < job.blocks) name##_block(&job, (int)blockIdx.x);        \
    }
#else
#define FOUR __attribute__((aligned(16)))
#ifndef MEET
#define EACH_THREAD for (int t = 0; t < THREADS; t++)
#define OWN THREADS
#define MINE t
#define SHARED FOUR
#define MEET
#define BLOCKS(name, Job)                                                             \
    void name(const Job *job) { for (int block = 0; block < job->blocks; block++) name##_block(job, block); }
#define BLOCKS_OF_TWO(name, Job)                                                      \
    void name(const Job *jobs) {                                                      \
        for (int y = 0; y < 2; y++)                                                   \
            for (int block = 0; block < jobs[y].blocks; block++) name##_block(jobs + y, block); \
    }
#endif
#endif

/* four numbers that are loaded and stored at once */
typedef struct FOUR { float x[4]; } Four;
FN void copy_four(float *to, const float *from) { *(Four *)to = *(const Four *)from; }
FN void zero_four(float *to) {
    UNROLLED for (int i = 0; i < 4; i++) to[i] = 0.0f;
}

/* A part of the envs in a mini-batch. */
typedef struct {
    int first_row;    /* of its rows */
    int rows;         /* of its samples, and of their images where these are learnt from too */
    int samples;      /* that it has in the mini-batch */
    int first_order;  /* of these samples, in the order of all samples */
    int first_sample; /* of all its samples, among those of all parts */
    int first_env;
    int envs;
} Part;

/* The samples of the rows: their numbers among the samples of all parts, -1 for a row of zeros; and twice
 * the robot, plus one for an image. */
enum { AS_IT_IS, BOTH, IN_TURN };
typedef struct {
    const Part *part;
    const unsigned *order; /* of a part's samples, counted from its first one */
    const int *robot_of;   /* of each env */
    int *sample;
    int *robot;
    int blocks, parts, rows, passes, symmetry, epoch;
} Rows;

FN void polypod_learn_rows_block(const Rows *job, int block) {
    EACH_THREAD {
        int row = block * THREADS + t, p = 0;
        if (row < job->rows) {
            while (p + 1 < job->parts && job->part[p + 1].first_row <= row) p++;
            const Part *part = job->part + p;
            int pass = (row - part->first_row) / part->rows, place = (row - part->first_row) % part->rows;
            int sample = -1, robot = 0;
            if (place < part->samples) {
                int number = (int)job->order[part->first_order + place];
                int image = job->symmetry == BOTH ? pass : job->symmetry == IN_TURN ? (number + job->epoch) % 2 : 0;
                sample = part->first_sample + number;
                robot = 2 * job->robot_of[part->first_env + number % part->envs] + image;
            }
            job->sample[row] = sample;
            job->robot[row] = robot;
        }
    }
}
BLOCKS(polypod_learn_rows, Rows)

/* Inputs of a network: observations or their images, the columns that it reads, normalised. */
typedef struct {
    const float *observations; /* [sample][numbers, rounded up to lines] */
    const int *sample;
    const int *robot;
    const int *index; /* images of numbers, [robot][numbers], and their signs */
    const float *sign;
    const int *columns;   /* null: all of them */
    const float *mean;    /* null: no statistics */
    const float *inverse; /* of the deviations */
    float *input;         /* [row][pitch] */
    int blocks, rows, numbers, inputs, pitch;
} Inputs;

FN void polypod_learn_inputs_block(const Inputs *job, int block) {
    EACH_THREAD {
        int row = block * (THREADS / LINE) + t / LINE;
        if (row < job->rows) {
            int sample = job->sample[row], robot = job->robot[row], stride = (job->numbers + LINE - 1) / LINE * LINE;
            const float *from = job->observations + (size_t)(sample < 0 ? 0 : sample) * stride;
            const int *index = robot % 2 ? job->index + (size_t)(robot / 2) * job->numbers : (const int *)0;
            for (int i = t % LINE; i < job->pitch; i += LINE) {
                float x = 0.0f;
                if (i < job->inputs && sample >= 0) {
                    int column = job->columns ? job->columns[i] : i;
                    x = index ? from[index[column]] * job->sign[(size_t)(robot / 2) * job->numbers + column] : from[column];
                }
                if (job->mean && sample >= 0) x = (x - job->mean[i]) * job->inverse[i];
                job->input[(size_t)row * job->pitch + i] = x;
            }
        }
    }
}
BLOCKS_OF_TWO(polypod_learn_inputs, Inputs)

enum { NO_ACTIVATION, ELU, RELU, TANH };
FN float activated(int activation, float x) {
    if (activation == ELU) return 0.0f < x ? x : exp_(min_(x, 0.0f)) - 1.0f;
    if (activation == RELU) return 0.0f < x ? x : 0.0f;
    if (activation != TANH) return x;
    float y = tanh_positive(fabsf(x));
    return x < 0.0f ? -y : y;
}
/* the derivative where the function is y */
FN float derivative(int activation, float y) {
    if (activation == ELU) return 0.0f < y ? 1.0f : y + 1.0f;
    if (activation == RELU) return 0.0f < y ? 1.0f : 0.0f;
    return nfma(y, y, 1.0f);
}

/* Adds DEPTH products to the sums of a thread. */
FN void multiply(float sums[8][4], float (*a)[PITCH], float (*b)[PITCH], int t) {
    UNROLLED for (int k = 0; k < DEPTH; k++) {
        float x[8], y[4];
        copy_four(x, &a[k][t / 16 * 8]);
        copy_four(x + 4, &a[k][t / 16 * 8 + 4]);
        copy_four(y, &b[k][t % 16 * 4]);
        UNROLLED for (int i = 0; i < 8; i++)
            UNROLLED for (int j = 0; j < 4; j++) sums[i][j] = fma_(x[i], y[j], sums[i][j]);
    }
}

/* The output of a layer, or of its inputs' derivatives on the way back. */
typedef struct {
    const float *a;       /* [row][pitch_a] */
    const float *weights; /* of the layer */
    const float *y;       /* on the way back: outputs of the layer below, at which its activation is derived */
    float *out;           /* [row][pitch] */
    int blocks, rows, inner, pitch_a, pitch;
    int lines; /* of a panel of the weights: inputs, rounded up to DEPTH, and the bias */
    int back, activation;
} Product;

/* Four numbers of a tile of `a`, and of one of the weights, that thread t loads. */
FN void load_rows(const Product *job, int row, int k, int t, float *to) {
    if (row + t / 2 < job->rows) copy_four(to, job->a + (size_t)(row + t / 2) * job->pitch_a + k + t % 2 * 4);
    else zero_four(to);
}
FN void load_weights(const Product *job, int column, int k, int t, float *to) {
    const float *from = job->weights;
    int fits;
    if (job->back) {
        int input = column + t / 2, output = k + t % 2 * 4;
        fits = input + 1 < job->lines;
        from += ((size_t)(output / LINE) * job->lines + input) * LINE + output % LINE;
    } else {
        int output = column + t % 16 * 4;
        fits = output < job->pitch;
        from += ((size_t)(output / LINE) * job->lines + k + t / 16) * LINE + output % LINE;
    }
    if (fits) copy_four(to, from);
    else zero_four(to);
}
/* Stores four steps of a row. */
FN void store_turned(float (*tile)[PITCH], int t, const float *from) {
    UNROLLED for (int i = 0; i < 4; i++) tile[t % 2 * 4 + i][t / 2] = from[i];
}
FN void store_tiles(const Product *job, float (*a)[PITCH], float (*b)[PITCH], int t, const float *from_a, const float *from_b) {
    store_turned(a, t, from_a);
    if (job->back) store_turned(b, t, from_b);
    else copy_four(&b[t / 16][t % 16 * 4], from_b);
}

FN void polypod_learn_product_block(const Product *job, int block) {
    SHARED float a[2][DEPTH][PITCH];
    SHARED float b[2][DEPTH][PITCH];
    FOUR float sums[OWN][8][4], next_a[OWN][4], next_b[OWN][4];
    int tiles = (job->pitch + TILE - 1) / TILE, row = block / tiles * TILE, column = block % tiles * TILE;
    EACH_THREAD {
        int first = column + t % 16 * 4;
        const float *bias = job->weights + ((size_t)(first / LINE) * job->lines + job->inner) * LINE + first % LINE;
        UNROLLED for (int i = 0; i < 8; i++) {
            if (!job->back && first < job->pitch) copy_four(sums[MINE][i], bias);
            else zero_four(sums[MINE][i]);
        }
        load_rows(job, row, 0, t, next_a[MINE]);
        load_weights(job, column, 0, t, next_b[MINE]);
        store_tiles(job, a[0], b[0], t, next_a[MINE], next_b[MINE]);
    }
    MEET;
    ROLLED for (int k = 0; k < job->inner; k += DEPTH) {
        int now = k / DEPTH % 2, goes_on = k + DEPTH < job->inner;
        /* the next numbers are under way while these are multiplied */
        EACH_THREAD {
            if (goes_on) {
                load_rows(job, row, k + DEPTH, t, next_a[MINE]);
                load_weights(job, column, k + DEPTH, t, next_b[MINE]);
            }
        }
        EACH_THREAD { multiply(sums[MINE], a[now], b[now], t); }
        EACH_THREAD {
            if (goes_on) store_tiles(job, a[1 - now], b[1 - now], t, next_a[MINE], next_b[MINE]);
        }
        MEET;
    }
    EACH_THREAD {
        int first = column + t % 16 * 4;
        UNROLLED for (int i = 0; i < 8; i++) {
            int r = row + t / 16 * 8 + i;
            if (r < job->rows && first < job->pitch) {
                size_t at = (size_t)r * job->pitch + first;
                UNROLLED for (int j = 0; j < 4; j++) {
                    float x = sums[MINE][i][j];
                    sums[MINE][i][j] = job->back ? x * derivative(job->activation, job->y[at + j]) : activated(job->activation, x);
                }
                copy_four(job->out + at, sums[MINE][i]);
            }
        }
    }
}
BLOCKS_OF_TWO(polypod_learn_product, Product)

/* Sum of the numbers of a line, as `Line::sum`. */
FN void add_half(float *x, int half) {
    UNROLLED for (int i = 0; i < half; i++) x[i] += x[i + half];
}
FN float sum_of_line(float *x) {
    add_half(x, 8);
    add_half(x, 4);
    add_half(x, 2);
    return x[0] + x[1];
}

/* numbers of a robot that all its samples share */
enum { CONSTANT, OF_DEVIATIONS, ABOUT, SCALE, PULL, SCALARS };
/* The surrogate loss of each row, and its derivatives. */
typedef struct {
    const float *output; /* [row][width] */
    float *delta;        /* derivatives with respect to the means */
    const int *sample;
    const int *robot;
    const float *actions; /* [sample][width] */
    const float *means;
    const float *log_probs; /* [sample] */
    const float *advantages;
    const int *index; /* images of actions, [robot][actions], and their signs */
    const float *sign;
    const float *inverse; /* of the deviations, [robot][width] */
    const float *scalars; /* [robot][SCALARS] */
    float *terms;         /* derivatives with respect to the deviations, [row][width] */
    float *loss;          /* [row] */
    float *divergence;
    int blocks, rows, numbers, width;
    float clip, weight;
} Surrogate;

FN void surrogate_of_row(const Surrogate *job, int row) {
    int sample = job->sample[row], robot = job->robot[row] / 2, width = job->width;
    float *delta = job->delta + (size_t)row * width, *terms = job->terms + (size_t)row * width;
    if (sample < 0) {
        for (int i = 0; i < width; i++) delta[i] = 0.0f;
        return;
    }
    const float *mean = job->output + (size_t)row * width, *inverse = job->inverse + (size_t)robot * width;
    const float *action = job->actions + (size_t)sample * width, *old = job->means + (size_t)sample * width;
    const float *scalars = job->scalars + robot * SCALARS, *sign = job->sign + (size_t)robot * job->numbers;
    const int *index = job->robot[row] % 2 ? job->index + (size_t)robot * job->numbers : (const int *)0;
    float sum = 0.0f, moved = 0.0f;
    ROLLED for (int line = 0; line < width; line += LINE) {
        float squares[LINE], moves[LINE];
        UNROLLED for (int i = 0; i < LINE; i++) {
            int k = line + i;
            float x = 0.0f;
            if (k < job->numbers) x = index ? action[index[k]] * sign[k] : action[k];
            /* nobody reads the divergence of an image */
            float z = (x - mean[k]) * inverse[k], d = (old[k] - mean[k]) * inverse[k];
            /* kept for the second pass */
            terms[k] = x;
            squares[i] = z * z;
            moves[i] = d * d;
        }
        sum += sum_of_line(squares);
        moved += sum_of_line(moves);
    }
    float advantage = (job->advantages[sample] - scalars[ABOUT]) * scalars[SCALE];
    float ratio = exp_(scalars[CONSTANT] - 0.5f * sum - job->log_probs[sample]);
    float lowest = 1.0f - job->clip, highest = 1.0f + job->clip;
    float near = ratio < lowest ? lowest : ratio > highest ? highest : ratio;
    float free = -advantage * ratio, clipped = -advantage * near;
    /* where the clipped loss is the greater one, it does not depend on the policy */
    float slope = free >= clipped ? free * job->weight : 0.0f;
    ROLLED for (int k = 0; k < width; k++) {
        float z = (terms[k] - mean[k]) * inverse[k];
        delta[k] = slope * z * inverse[k];
        terms[k] = slope * (z * z - 1.0f) * inverse[k];
    }
    /* the mirror loss of an image, whose target is the image of the old mean */
    if (index && scalars[PULL] > 0.0f) {
        ROLLED for (int k = 0; k < width; k++)
            delta[k] += inverse[k] > 0.0f ? scalars[PULL] * (mean[k] - old[index[k]] * sign[k]) : 0.0f;
    }
    job->loss[row] = free < clipped ? clipped : free;
    job->divergence[row] = scalars[OF_DEVIATIONS] + 0.5f * moved;
}

FN void polypod_learn_surrogate_block(const Surrogate *job, int block) {
    EACH_THREAD {
        if (block * THREADS + t < job->rows) surrogate_of_row(job, block * THREADS + t);
    }
}
BLOCKS(polypod_learn_surrogate, Surrogate)

/* The value loss of each row, and its derivative. */
typedef struct {
    const float *output; /* [row][LINE] */
    float *delta;
    const int *sample;
    const float *returns; /* [sample] */
    const float *values;
    float *loss; /* [row] */
    int blocks, rows, is_clipped;
    float clip, coefficient, weight;
} Value;

FN void polypod_learn_value_block(const Value *job, int block) {
    EACH_THREAD {
        int row = block * THREADS + t;
        if (row < job->rows) {
            int sample = job->sample[row];
            float *delta = job->delta + (size_t)row * LINE;
            for (int i = 0; i < LINE; i++) delta[i] = 0.0f;
            if (sample >= 0) {
                float value = job->output[(size_t)row * LINE], target = job->returns[sample], old = job->values[sample];
                float loss = (value - target) * (value - target), slope = 2.0f * (value - target);
                if (job->is_clipped) {
                    float moved = value - old;
                    float near = old + (moved < -job->clip ? -job->clip : moved > job->clip ? job->clip : moved);
                    float clipped = (near - target) * (near - target);
                    if (clipped > loss) {
                        /* within the limits, the two differ by rounding alone */
                        loss = clipped;
                        if (!(fabsf(moved) <= job->clip)) slope = 0.0f;
                    }
                }
                job->loss[row] = loss;
                delta[0] = job->coefficient * slope * job->weight;
            }
        }
    }
}
BLOCKS(polypod_learn_value, Value)

/* figures of a part: sums of both losses and of the divergence, rows that are no images */
enum { SURROGATE_LOSS, VALUE_LOSS, DIVERGENCE, AS_THEY_ARE, FIGURES };
/* Sums over the samples of each part, in their order. */
typedef struct {
    const Part *part;
    const int *robot;        /* [row] */
    const float *terms;      /* [row][width] */
    const float *surrogate;  /* [row] */
    const float *value;
    const float *divergence;
    const float *start; /* derivatives of the deviations to begin with, [part][width] */
    float *gradient;    /* of the first part's deviations */
    double *figures;    /* [part][FIGURES] */
    long long part_numbers; /* between the gradients of two parts */
    int blocks, passes, width;
} Chains;

FN double figure_of_part(const Chains *job, const Part *part, int figure) {
    const float *x = figure == SURROGATE_LOSS ? job->surrogate : figure == VALUE_LOSS ? job->value : job->divergence;
    double sum = 0.0;
    for (int pass = 0; pass < job->passes; pass++) {
        int first = part->first_row + pass * part->rows;
        BY_EIGHT for (int row = first; row < first + part->samples; row++) {
            if (figure == AS_THEY_ARE) sum += job->robot[row] % 2 ? 0.0 : 1.0;
            else if (figure != DIVERGENCE || job->robot[row] % 2 == 0) sum += (double)x[row];
        }
    }
    return sum;
}

FN void polypod_learn_chains_block(const Chains *job, int block) {
    const Part *part = job->part + block;
    EACH_THREAD {
        for (int i = t; i < job->width + FIGURES; i += THREADS) {
            if (i >= job->width) {
                int figure = i - job->width;
                job->figures[block * FIGURES + figure] = figure_of_part(job, part, figure);
                continue;
            }
            float sum = job->start[(size_t)block * job->width + i];
            for (int pass = 0; pass < job->passes; pass++) {
                int first = part->first_row + pass * part->rows;
                BY_EIGHT for (int row = first; row < first + part->samples; row++)
                    sum += job->terms[(size_t)row * job->width + i];
            }
            job->gradient[block * job->part_numbers + i] = sum;
        }
    }
}
BLOCKS(polypod_learn_chains, Chains)

/* The derivatives of a layer's weights, of each part. */
typedef struct {
    const float *input; /* [row][pitch_input] */
    const float *delta; /* [row][pitch] */
    const Part *part;
    float *gradient;        /* of the layer and the first part */
    long long part_numbers; /* between the gradients of two parts */
    int blocks, passes, inner, pitch_input, pitch;
} WeightGradient;

/* Four columns that thread t loads of a row. */
FN void load_columns(const float *from, int pitch, int row, int column, int t, float *to) {
    if (column + t % 16 * 4 < pitch) copy_four(to, from + (size_t)(row + t / 16) * pitch + column + t % 16 * 4);
    else zero_four(to);
}

FN void polypod_learn_weights_block(const WeightGradient *job, int block) {
    SHARED float a[2][DEPTH][PITCH];
    SHARED float b[2][DEPTH][PITCH];
    FOUR float sums[OWN][8][4], next_a[OWN][4], next_b[OWN][4];
    float bias[OWN];
    int tiles = (job->pitch + TILE - 1) / TILE, of_inputs = (job->inner + TILE - 1) / TILE;
    int column = block % tiles * TILE, input = block / tiles % of_inputs * TILE, number = block / tiles / of_inputs;
    const Part *part = job->part + number;
    int row = part->first_row, end = row + job->passes * part->rows;
    EACH_THREAD {
        UNROLLED for (int i = 0; i < 8; i++) zero_four(sums[MINE][i]);
        bias[MINE] = 0.0f;
        if (row < end) {
            load_columns(job->input, job->pitch_input, row, input, t, next_a[MINE]);
            load_columns(job->delta, job->pitch, row, column, t, next_b[MINE]);
            copy_four(&a[0][t / 16][t % 16 * 4], next_a[MINE]);
            copy_four(&b[0][t / 16][t % 16 * 4], next_b[MINE]);
        }
    }
    MEET;
    ROLLED for (int now = 0; row < end; row += DEPTH, now = 1 - now) {
        int goes_on = row + DEPTH < end;
        EACH_THREAD {
            if (goes_on) {
                load_columns(job->input, job->pitch_input, row + DEPTH, input, t, next_a[MINE]);
                load_columns(job->delta, job->pitch, row + DEPTH, column, t, next_b[MINE]);
            }
        }
        EACH_THREAD {
            multiply(sums[MINE], a[now], b[now], t);
            if (input == 0 && t < TILE)
                UNROLLED for (int k = 0; k < DEPTH; k++) bias[MINE] += b[now][k][t];
        }
        EACH_THREAD {
            if (goes_on) {
                copy_four(&a[1 - now][t / 16][t % 16 * 4], next_a[MINE]);
                copy_four(&b[1 - now][t / 16][t % 16 * 4], next_b[MINE]);
            }
        }
        MEET;
    }
    float *gradient = job->gradient + number * job->part_numbers;
    EACH_THREAD {
        int first = column + t % 16 * 4, lines = job->inner + 1;
        UNROLLED for (int i = 0; i < 8; i++) {
            int k = input + t / 16 * 8 + i;
            if (k < job->inner && first < job->pitch)
                copy_four(gradient + ((size_t)(first / LINE) * lines + k) * LINE + first % LINE, sums[MINE][i]);
        }
        int output = column + t;
        if (input == 0 && t < TILE && output < job->pitch)
            gradient[((size_t)(output / LINE) * lines + job->inner) * LINE + output % LINE] = bias[MINE];
    }
}
BLOCKS_OF_TWO(polypod_learn_weights, WeightGradient)

/* The sum of the parts' gradients in the order of the tree, and the squares of the sums. */
typedef struct {
    const float *gradients; /* [part][part_numbers] */
    const int *complete;    /* sums that are complete with each part */
    float *total;
    double *squares; /* [CHUNK of the numbers][LINE] */
    long long part_numbers;
    int blocks, parts, numbers;
} Total;

FN void polypod_learn_total_block(const Total *job, int block) {
    int first = block * CHUNK, end = first + CHUNK < job->numbers ? first + CHUNK : job->numbers;
    EACH_THREAD {
        for (int i = first + t; i < end; i += THREADS) {
            float waiting[WAITING] = {0.0f};
            int next = 0;
            for (int part = 0; part < job->parts; part++) {
                float sum = job->gradients[part * job->part_numbers + i];
                for (int k = job->complete[part]; k > 0; k--) sum = waiting[--next] + sum;
                waiting[next++] = sum;
            }
            job->total[i] = waiting[0];
        }
    }
    MEET;
    EACH_THREAD {
        if (t < LINE) {
            double sum = 0.0;
            BY_EIGHT for (int i = first + t; i < end; i += LINE) {
                double x = (double)job->total[i];
                sum += x * x;
            }
            job->squares[block * LINE + t] = sum;
        }
    }
}
BLOCKS_OF_TWO(polypod_learn_total, Total)

/* A step of Adam. */
typedef struct {
    float *weights;
    float *first; /* the mean of the gradients, and of their squares */
    float *second;
    const float *gradient;
    int blocks, numbers;
    int first_deviation, end_deviation; /* numbers that stay within a range */
    float clip, rate, root;             /* see `Rates` in adam.rs */
    float keep, keep_squares, take, take_squares, epsilon;
    float lowest, highest;
} Step;

FN void polypod_learn_step_block(const Step *job, int block) {
    EACH_THREAD {
        int i = block * THREADS + t;
        if (i < job->numbers) {
            float g = job->gradient[i] * job->clip;
            float first = job->first[i] * job->keep + g * job->take;
            float second = job->second[i] * job->keep_squares + g * g * job->take_squares;
            float step = first / (sqrtf(second) / job->root + job->epsilon), weight = job->weights[i] - job->rate * step;
            /* Adam has no bounds: a small deviation with a large rate would become negative */
            if (job->first_deviation <= i && i < job->end_deviation)
                weight = weight < job->lowest ? job->lowest : weight > job->highest ? job->highest : weight;
            job->first[i] = first;
            job->second[i] = second;
            job->weights[i] = weight;
        }
    }
}
BLOCKS_OF_TWO(polypod_learn_step, Step)
