/* The joint-space mass matrix and its sparse factors: crates/dynamics/src/factor.rs. */
#ifndef POLYPOD_FACTOR_H
#define POLYPOD_FACTOR_H
#include "tables.h"

/* The mass matrix's row of joint j at a place of a block, from the composite inertia of its link, with its
 * armature, its damping, and the implicit shares of springs and actuators. */
FN void set_joint(Robot *a, int b, int place, int j, const float *inertia, const float *own_axis) {
    int block = BLOCK_AT(b), own = FACTOR(b), carriers = L(block + 4);
    float axis[6], force[6];
    momentum(inertia, own_axis, force);
    float dt = TC(DT), slope = W(T(W_SLOPE) + j) + P(P_JOINT_DAMPING, j);
    float diagonal = fma_(slope, dt, dot6(own_axis, force) + P(P_ARMATURE, j));
    if (T(HAS_SPRINGS)) diagonal = fma_(P(P_SPRING, 2 * j), dt * dt * TC(SPRING_STIFFNESS), diagonal);
    W(own + place) = diagonal;
    for (int t = 0; t < place; t++) {
        w_load(a, LINK(L(block + t) + 1) + LINK_AXIS, 6, axis);
        W(own + FACTOR_INNER + place + t - 1) = dot6(axis, force);
    }
    ROLLED for (int c = 0; c < carriers; c++) {
        int carrier = L(block + 5) + c * CARRIER_SIZE, joints = BLOCK_AT(L(carrier));
        for (int t = 0; t < BLOCK; t++) {
            float x = 0.0f;
            if (t < L(carrier + 1)) {
                w_load(a, LINK(L(joints + t) + 1) + LINK_AXIS, 6, axis);
                x = dot6(axis, force);
            }
            W(COUPLING(L(block + 6) + c) + 3 * place + t) = x;
        }
    }
    for (int r = 0; r < 6; r++) W(own + FACTOR_BASE + 6 * place + r) = T(FLOATING) ? force[r] : 0.0f;
}

/* The rows of the joints that a block does not have. */
FN void set_empty_places(Robot *a, int b) {
    int block = BLOCK_AT(b), own = FACTOR(b);
    ROLLED for (int place = L(block + 3); place < BLOCK; place++) {
        W(own + place) = 1.0f;
        for (int t = 0; t < place; t++) W(own + FACTOR_INNER + place + t - 1) = 0.0f;
        for (int r = 0; r < 6; r++) W(own + FACTOR_BASE + 6 * place + r) = 0.0f;
        ROLLED for (int c = 0; c < L(block + 4); c++)
            for (int t = 0; t < BLOCK; t++) W(COUPLING(L(block + 6) + c) + 3 * place + t) = 0.0f;
    }
}

/* The mass matrix's base block, from the composite inertia of the whole robot. */
FN void set_base(Robot *a, const float *x) {
    float *g = a->g;
    const float *h = x + 1, *i = x + 4;
    for (int k = 0; k < 36; k++) g[k] = 0.0f;
    set3(g, i[0], i[3], i[4]);
    set3(g + 6, i[3], i[1], i[5]);
    set3(g + 12, i[4], i[5], i[2]);
    g[4] = g[24] = -h[2];
    g[5] = g[30] = h[1];
    g[9] = g[19] = h[2];
    g[11] = g[31] = -h[0];
    g[15] = g[20] = -h[1];
    g[16] = g[26] = h[0];
    g[21] = g[28] = g[35] = x[0];
}

/* Splits a pivot evenly: its root and the inverse; the inverse of the pivot. */
FN float split(float pivot, float *root) {
    root[0] = sqrtf(pivot);
    root[1] = 1.0f / root[0];
    return root[1] * root[1];
}

/* Turns a tree's part of the mass matrix, held in place, into its factors. */
FN void factorise_tree(Robot *a, int tree) {
    INWARD(tree, place) {
        int b = TREE_BLOCK(tree, place), block = BLOCK_AT(b), own = FACTOR(b);
        int carriers = L(block + 4), first = L(block + 6);
        float d[3], m[3], root[6], base[18];
        w_load(a, own, 3, d);
        w_load(a, own + FACTOR_INNER, 3, m);
        float i2 = split(d[2], root + 4);
        float l20 = m[1] * i2, l21 = m[2] * i2;
        float m10 = nfma(l21, m[1], m[0]);
        float i1 = split(nfma(l21, m[2], d[1]), root + 2);
        float l10 = m10 * i1;
        float i0 = split(nfma(l10, m10, nfma(l20, m[1], d[0])), root);
        float inverse[3] = {i0, i1, i2};
        w_store(a, ROOT(b), 6, root);
        W(own + FACTOR_INNER) = l10;
        W(own + FACTOR_INNER + 1) = l20;
        W(own + FACTOR_INNER + 2) = l21;
        w_load(a, own + FACTOR_BASE, 18, base);
        for (int r = 0; r < 6; r++) {
            float b1 = nfma(l21, base[12 + r], base[6 + r]);
            float b0 = nfma(l20, base[12 + r], base[r]);
            base[r] = nfma(l10, b1, b0);
            base[6 + r] = b1;
        }
        ROLLED for (int k = 0; k < carriers; k++) {
            int c = COUPLING(first + k);
            for (int t = 0; t < BLOCK; t++) {
                float c1 = nfma(l21, W(c + 6 + t), W(c + 3 + t));
                float c0 = nfma(l20, W(c + 6 + t), W(c + t));
                W(c + t) = nfma(l10, c1, c0);
                W(c + 3 + t) = c1;
            }
        }
        ROLLED for (int p = 0; p < carriers; p++) {
            int carrier = L(L(block + 5) + p * CARRIER_SIZE), on = FACTOR(carrier);
            float nearest[9], l[9];
            w_load(a, COUPLING(first + p), 9, nearest);
            for (int k = 0; k < 9; k++) l[k] = nearest[k] * inverse[k / 3];
            for (int s = 0; s < BLOCK; s++) {
                for (int t = 0; t < BLOCK; t++) {
                    W(on + t) = nfma(l[3 * s + t], nearest[3 * s + t], W(on + t));
                    for (int u = 0; u < t; u++) {
                        int at = on + FACTOR_INNER + t + u - 1;
                        W(at) = nfma(l[3 * s + t], nearest[3 * s + u], W(at));
                    }
                    for (int r = 0; r < 6; r++) {
                        int at = on + FACTOR_BASE + 6 * t + r;
                        W(at) = nfma(l[3 * s + t], base[6 * s + r], W(at));
                    }
                }
            }
            int others = L(BLOCK_AT(carrier) + 6);
            ROLLED for (int k = p + 1; k < carriers; k++) {
                int c = COUPLING(first + k), to = COUPLING(others + k - p - 1);
                for (int s = 0; s < BLOCK; s++)
                    for (int t = 0; t < BLOCK; t++)
                        for (int u = 0; u < BLOCK; u++)
                            W(to + 3 * t + u) = nfma(l[3 * s + t], W(c + 3 * s + u), W(to + 3 * t + u));
            }
            w_store(a, COUPLING(first + p), 9, l);
        }
        w_store(a, own + FACTOR_RAW, 18, base);
        for (int k = 0; k < 18; k++) base[k] = base[k] * inverse[k / 6];
        w_store(a, own + FACTOR_BASE, 18, base);
    }
}

/* Turns the base's part of the mass matrix into its factors, after those of the trees. */
FN void factorise_base(Robot *a) {
    float *g = a->g;
    ROLLED for (int b = T(BLOCKS) - 1; b >= 0; b--) {
        float base[18], x[18];
        w_load(a, FACTOR(b) + FACTOR_RAW, 18, base);
        w_load(a, FACTOR(b) + FACTOR_BASE, 18, x);
        for (int r = 0; r < 6; r++) {
            for (int c = r; c < 6; c++) {
                float y = nfma(x[r], base[c], g[6 * c + r]);
                y = nfma(x[6 + r], base[6 + c], y);
                g[6 * c + r] = nfma(x[12 + r], base[12 + c], y);
            }
        }
    }
    for (int k = 0; k < 12; k++) a->root[k] = 0.0f;
    if (!T(FLOATING)) return;
    for (int k = 0; k < 6; k++) {
        float inverse = split(g[7 * k], a->root + 2 * k);
        for (int r = k + 1; r < 6; r++) {
            float x = g[6 * r + k] * inverse;
            for (int c = k + 1; c <= r; c++) g[6 * r + c] = nfma(x, g[6 * c + k], g[6 * r + c]);
        }
        for (int r = k + 1; r < 6; r++) g[6 * r + k] = g[6 * r + k] * inverse;
    }
}

FN void base_forward(const Robot *a, float *b) {
    for (int k = 0; k < 5; k++)
        for (int r = k + 1; r < 6; r++) b[r] = nfma(a->g[6 * r + k], b[k], b[r]);
}

/* H^-T b and H u of a tree's joints: the half solve of the generalised force in the columns `force`,
 * [blocks], which is then to be multiplied by the inverse roots; and the velocity in the columns `joints`
 * in the coordinates in which constraint rows are sparse, for that of the base. Their sum goes to `moved`. */
FN void solve_tree(Robot *a, int tree, const float *base, int force, int joints, int moved) {
    INWARD(tree, k) {
        int b = TREE_BLOCK(tree, k), block = BLOCK_AT(b), own = FACTOR(b), x = force + 3 * b, at = joints + 3 * b;
        float l10 = W(own + FACTOR_INNER), l20 = W(own + FACTOR_INNER + 1), l21 = W(own + FACTOR_INNER + 2);
        float x2 = W(x + 2), x1 = nfma(l21, x2, W(x + 1)), x0 = nfma(l10, x1, nfma(l20, x2, W(x)));
        ROLLED for (int c = 0; c < L(block + 4); c++) {
            int l = COUPLING(L(block + 6) + c), on = force + 3 * L(L(block + 5) + c * CARRIER_SIZE);
            for (int t = 0; t < BLOCK; t++) {
                float y = nfma(W(l + 6 + t), x2, W(on + t));
                W(on + t) = nfma(W(l + t), x0, nfma(W(l + 3 + t), x1, y));
            }
        }
        W(x) = x0;
        W(x + 1) = x1;
        float u0 = W(at), u1 = W(at + 1), u2 = W(at + 2), solved[3] = {x0, x1, x2};
        float u[3] = {u0, fma_(l10, u0, u1), fma_(l21, u1, fma_(l20, u0, u2))};
        ROLLED for (int c = 0; c < L(block + 4); c++) {
            int l = COUPLING(L(block + 6) + c), from = joints + 3 * L(L(block + 5) + c * CARRIER_SIZE);
            for (int s = 0; s < BLOCK; s++)
                for (int t = 0; t < BLOCK; t++) u[s] = fma_(W(l + 3 * s + t), W(from + t), u[s]);
        }
        for (int s = 0; s < BLOCK; s++) {
            for (int r = 0; r < 6; r++) u[s] = fma_(W(own + FACTOR_BASE + 6 * s + r), base[r], u[s]);
            float sparse = u[s] * W(ROOT(b) + 2 * s);
            W(at + s) = sparse;
            W(moved + 3 * b + s) = sparse + solved[s] * W(ROOT(b) + 2 * s + 1);
        }
    }
}

/* The base's part of the half solve, after the trees. */
FN void half_solve_base(Robot *a, float *base, int force) {
    ROLLED for (int b = T(BLOCKS) - 1; b >= 0; b--) {
        int on = FACTOR(b) + FACTOR_BASE;
        float x[3];
        w_load(a, force + 3 * b, 3, x);
        for (int r = 0; r < 6; r++) {
            float y = nfma(W(on + 12 + r), x[2], base[r]);
            base[r] = nfma(W(on + r), x[0], nfma(W(on + 6 + r), x[1], y));
        }
    }
    if (T(FLOATING)) base_forward(a, base);
    for (int r = 0; r < 6; r++) base[r] = base[r] * a->root[2 * r + 1];
}

/* The base's part of H u. */
FN void to_sparse_base(const Robot *a, float *base) {
    if (T(FLOATING))
        for (int k = 0; k < 5; k++)
            for (int r = k + 1; r < 6; r++) base[k] = fma_(a->g[6 * r + k], base[r], base[k]);
    for (int r = 0; r < 6; r++) base[r] = base[r] * a->root[2 * r];
}

/* H^-1 y, the velocity of a sparse one: first the base's part. */
FN void to_dense_base(const Robot *a, float *base) {
    for (int r = 0; r < 6; r++) base[r] = base[r] * a->root[2 * r + 1];
    if (T(FLOATING))
        for (int k = 5; k >= 0; k--)
            for (int r = k + 1; r < 6; r++) base[k] = nfma(a->g[6 * r + k], base[r], base[k]);
}

/* Then a tree's joints, from the columns `sparse` to the columns `joints`. */
FN void to_dense_tree(Robot *a, int tree, const float *base, int sparse, int joints) {
    OUTWARD(tree, k) {
        int b = TREE_BLOCK(tree, k), block = BLOCK_AT(b), own = FACTOR(b), at = joints + 3 * b;
        float x[3];
        for (int s = 0; s < BLOCK; s++) {
            x[s] = W(sparse + 3 * b + s) * W(ROOT(b) + 2 * s + 1);
            for (int r = 0; r < 6; r++) x[s] = nfma(W(own + FACTOR_BASE + 6 * s + r), base[r], x[s]);
        }
        ROLLED for (int c = 0; c < L(block + 4); c++) {
            int l = COUPLING(L(block + 6) + c), from = joints + 3 * L(L(block + 5) + c * CARRIER_SIZE);
            for (int s = 0; s < BLOCK; s++)
                for (int t = 0; t < BLOCK; t++) x[s] = nfma(W(l + 3 * s + t), W(from + t), x[s]);
        }
        float l10 = W(own + FACTOR_INNER), l20 = W(own + FACTOR_INNER + 1), l21 = W(own + FACTOR_INNER + 2);
        float x1 = nfma(l10, x[0], x[1]);
        W(at) = x[0];
        W(at + 1) = x1;
        W(at + 2) = nfma(l21, x1, nfma(l20, x[0], x[2]));
    }
}
#endif
