/* Numbers, vectors and elementary functions: each is one IEEE 754 operation of single precision or a
 * fixed sequence of them, in the order in which crates/lanes and crates/dynamics/src/math.rs have
 * it. No function of a math library is called but fmaf, sqrtf, rintf and fabsf, which are exact or
 * correctly rounded on every machine. */
#ifndef POLYPOD_NUMBERS_H
#define POLYPOD_NUMBERS_H

#ifdef __CUDACC__
/* Parts that several others call stand at each place: one copy of each is compiled in a third of the
 * time and steps at a third of the speed. */
#define FN static __device__ __forceinline__
#define KERNEL extern "C" __global__
/* of loops over parts of a robot: unrolled, the code would not fit into a multiprocessor's cache */
#define ROLLED _Pragma("unroll 1")
/* of loops over the joints of a block, whose numbers are in registers */
#define UNROLLED _Pragma("unroll")
/* of loops over the inputs of a layer, whose sums are in registers */
#define BY_TWO _Pragma("unroll 2")
/* of loops over joints that wait for memory */
#define BY_THREE _Pragma("unroll 3")
/* of loops that wait for memory and do little else */
#define BY_EIGHT _Pragma("unroll 8")
/* of memory that no robot writes */
#define READ(at) __ldg(at)
#define TABLE static __constant__ const
#ifndef LANES
#define LANES 4
#endif
#if LANES > 1
/* All threads of a warp meet here, so that each sees what the others wrote. */
#define SYNC __syncwarp()
/* a variable of another thread of the robot */
#define FROM_LANE(x, lane) __shfl_sync(~0u, x, lane, LANES)
#else
#define ALONE
#endif
#else
#include <math.h>
#include <stddef.h>
#define FN static inline
#define ROLLED
#define UNROLLED
#define BY_TWO
#define BY_THREE
#define BY_EIGHT
#define READ(at) (*(at))
#define TABLE static const
#ifndef LANES
#define LANES 1
#define ALONE
#endif
#endif
#ifdef ALONE
#define SYNC
#define FROM_LANE(x, lane) (x)
#endif

/* joints of a block */
#define BLOCK 3
/* target speed of an absent contact, m/s */
#define NO_TARGET (-1e6f)

/* a b + c and c - a b, rounded once */
FN float fma_(float a, float b, float c) { return fmaf(a, b, c); }
FN float nfma(float a, float b, float c) { return fmaf(-a, b, c); }
/* the second number when either is NaN */
FN float min_(float a, float b) { return a < b ? a : b; }
FN float max_(float a, float b) { return b < a ? a : b; }
FN float clamp_(float x, float lower, float upper) { return min_(max_(x, lower), upper); }

FN void set3(float *o, float x, float y, float z) {
    o[0] = x;
    o[1] = y;
    o[2] = z;
}
FN void copy(float *o, const float *a, int n) {
    for (int i = 0; i < n; i++) o[i] = a[i];
}
FN float dot(const float *a, const float *b) { return fma_(a[0], b[0], fma_(a[1], b[1], a[2] * b[2])); }
/* Results may be written over arguments. */
FN void cross(const float *a, const float *b, float *o) {
    set3(o, nfma(a[2], b[1], a[1] * b[2]), nfma(a[0], b[2], a[2] * b[0]), nfma(a[1], b[0], a[0] * b[1]));
}
FN void cross_add(const float *a, const float *b, const float *c, float *o) {
    set3(o, nfma(a[2], b[1], fma_(a[1], b[2], c[0])), nfma(a[0], b[2], fma_(a[2], b[0], c[1])),
         nfma(a[1], b[0], fma_(a[0], b[1], c[2])));
}
FN void add(const float *a, const float *b, float *o) { set3(o, a[0] + b[0], a[1] + b[1], a[2] + b[2]); }
FN void sub(const float *a, const float *b, float *o) { set3(o, a[0] - b[0], a[1] - b[1], a[2] - b[2]); }
FN void scale(const float *a, float s, float *o) { set3(o, a[0] * s, a[1] * s, a[2] * s); }
FN void add_scaled(const float *a, const float *b, float s, float *o) {
    set3(o, fma_(b[0], s, a[0]), fma_(b[1], s, a[1]), fma_(b[2], s, a[2]));
}
/* Matrices are row-major, symmetric ones are xx, yy, zz, xy, xz, yz. */
FN void mul_vec(const float *m, const float *v, float *o) { set3(o, dot(m, v), dot(m + 3, v), dot(m + 6, v)); }
FN void mul_vec_transposed(const float *m, const float *v, float *o) {
    set3(o, fma_(m[0], v[0], fma_(m[3], v[1], m[6] * v[2])), fma_(m[1], v[0], fma_(m[4], v[1], m[7] * v[2])),
         fma_(m[2], v[0], fma_(m[5], v[1], m[8] * v[2])));
}
FN void mul_mat(const float *a, const float *b, float *o) {
    for (int i = 0; i < 3; i++) mul_vec_transposed(b, a + 3 * i, o + 3 * i);
}
FN void mul_sym(const float *s, const float *v, float *o) {
    set3(o, fma_(s[0], v[0], fma_(s[3], v[1], s[4] * v[2])), fma_(s[3], v[0], fma_(s[1], v[1], s[5] * v[2])),
         fma_(s[4], v[0], fma_(s[5], v[1], s[2] * v[2])));
}
FN void rotate_sym(const float *r, const float *s, float *o) {
    float t[9];
    for (int i = 0; i < 3; i++) mul_sym(s, r + 3 * i, t + 3 * i);
    o[0] = dot(t, r);
    o[1] = dot(t + 3, r + 3);
    o[2] = dot(t + 6, r + 6);
    o[3] = dot(t, r + 3);
    o[4] = dot(t, r + 6);
    o[5] = dot(t + 3, r + 6);
}
FN void quat_to_mat(const float *q, float *m) {
    float w = q[0], x = q[1], y = q[2], z = q[3];
    float x2 = x + x, y2 = y + y, z2 = z + z;
    float xx = x * x2, yy = y * y2, zz = z * z2, xy = x * y2, xz = x * z2, yz = y * z2;
    float wx = w * x2, wy = w * y2, wz = w * z2;
    set3(m, 1.0f - (yy + zz), xy - wz, xz + wy);
    set3(m + 3, xy + wz, 1.0f - (xx + zz), yz - wx);
    set3(m + 6, xz - wy, yz + wx, 1.0f - (xx + yy));
}
/* q turned by the rotation vector w, rad */
FN void integrate_quat(float *q, const float *w) {
    float h[3], d[3], v[3], im[3], t[3];
    scale(w, 0.5f, h);
    float h2 = dot(h, h);
    float c = fma_((float)(-1.0 / 720.0), h2, (float)(1.0 / 24.0));
    c = fma_(fma_(c, h2, -0.5f), h2, 1.0f);
    float s = fma_((float)(-1.0 / 5040.0), h2, (float)(1.0 / 120.0));
    s = fma_(fma_(s, h2, (float)(-1.0 / 6.0)), h2, 1.0f);
    scale(h, s, d);
    set3(v, q[1], q[2], q[3]);
    float real = fma_(q[0], c, -dot(v, d));
    cross(v, d, t);
    add_scaled(t, v, c, t);
    add_scaled(t, d, q[0], im);
    float inverse = 1.0f / sqrtf(fma_(real, real, dot(im, im)));
    q[0] = real * inverse;
    set3(q + 1, im[0] * inverse, im[1] * inverse, im[2] * inverse);
}
/* sine and cosine of crates/lanes/src/elementary.rs */
FN void sin_cos(float x, float *sine, float *cosine) {
    float quadrant = rintf(x * (float)0.63661977236758134308);
    float r = nfma(quadrant, (float)1.5703125, x);
    r = nfma(quadrant, (float)4.837512969970703e-4, r);
    r = nfma(quadrant, (float)7.549789948768648e-8, r);
    float r2 = r * r;
    float s = fma_((float)-1.9515295891e-4, r2, (float)8.3321608736e-3);
    s = fma_(s, r2, (float)-1.6666654611e-1);
    s = fma_(s * r2, r, r);
    float c = fma_((float)2.443315711809948e-5, r2, (float)-1.388731625493765e-3);
    c = fma_(c, r2, (float)4.166664568298827e-2);
    c = fma_(c * r2, r2, fma_(-0.5f, r2, 1.0f));
    float turn = nfma(rintf(quadrant * 0.25f), 4.0f, quadrant);
    float size = fabsf(turn);
    int odd = (0.5f < size) & (size < 1.5f);
    float s1 = odd ? c : s, c1 = odd ? s : c;
    int half = 1.5f < size;
    int sin_negative = half | ((turn < -0.5f) & (-1.5f < turn));
    int cos_negative = half | ((0.5f < turn) & (turn < 1.5f));
    *sine = sin_negative ? -s1 : s1;
    *cosine = cos_negative ? -c1 : c1;
}

/* e^x, tanh of a number that is not negative, and the angle of (x, y), of the same file */
FN float exp_(float x) {
    float bounded = max_(min_(x, 88.0f), -87.0f);
    float k = rintf(bounded * (float)1.44269504088896340736);
    float r = nfma(k, (float)-2.1219444e-4, nfma(k, (float)0.6933594, bounded));
    float p = fma_((float)1.9875692e-4, r, (float)1.3981999e-3);
    p = fma_(fma_(p, r, (float)8.333452e-3), r, (float)4.1665796e-2);
    p = fma_(fma_(p, r, (float)0.16666666), r, 0.5f);
    float y = fma_(p, r * r, r) + 1.0f;
    union { int bits; float number; } power;
    power.bits = ((int)k + 127) * (1 << 23);
    return x < -87.0f ? 0.0f : y * power.number;
}
FN float tanh_positive(float x) {
    float e = exp_(-2.0f * x);
    return (1.0f - e) / (1.0f + e);
}
FN float atan2_(float y, float x) {
    float ax = fabsf(x), ay = fabsf(y);
    float small = ay < ax ? ay : ax, large = ay < ax ? ax : ay, t = 0.0f < large ? small / large : 0.0f, t2 = t * t;
    float p = fma_(0.0f, t2, (float)0.0028662257);
    p = fma_(p, t2, (float)-0.016165737);
    p = fma_(p, t2, (float)0.042909614);
    p = fma_(p, t2, (float)-0.07528964);
    p = fma_(p, t2, (float)0.10656264);
    p = fma_(p, t2, (float)-0.142089);
    p = fma_(p, t2, (float)0.19993551);
    p = fma_(p, t2, (float)-0.33333145);
    float a = fma_(p * t2, t, t);
    if (!(ay < ax)) a = (float)1.57079632679489661923 - a;
    if (x < 0.0f) a = (float)3.14159265358979323846 - a;
    return y < 0.0f ? -a : a;
}

/* Spatial vectors are angular, then linear, about the base's origin in base axes. */
FN float dot6(const float *a, const float *b) {
    return fma_(a[0], b[0], fma_(a[1], b[1], fma_(a[2], b[2], dot(a + 3, b + 3))));
}
FN void at_point(const float *m, const float *point, float *o) {
    float t[3];
    cross(m, point, t);
    add(m + 3, t, o);
}
FN void cross_motion(const float *a, const float *m, float *o) {
    float t[3];
    cross(a + 3, m, t);
    cross(a, m, o);
    cross_add(a, m + 3, t, o + 3);
}
/* Spatial inertias are mass, moment (3) and rotational inertia (6). */
FN void spatial_inertia(float mass, const float *c, const float *about, float *o) {
    float h[3], d[3];
    scale(c, mass, h);
    set3(d, c[0] * h[0], c[1] * h[1], c[2] * h[2]);
    o[0] = mass;
    copy(o + 1, h, 3);
    o[4] = about[0] + (d[1] + d[2]);
    o[5] = about[1] + (d[0] + d[2]);
    o[6] = about[2] + (d[0] + d[1]);
    o[7] = nfma(h[0], c[1], about[3]);
    o[8] = nfma(h[0], c[2], about[4]);
    o[9] = nfma(h[1], c[2], about[5]);
}
FN void momentum(const float *i, const float *m, float *o) {
    float t[3];
    mul_sym(i + 4, m, t);
    cross_add(i + 1, m + 3, t, o);
    scale(m + 3, i[0], t);
    cross_add(m, i + 1, t, o + 3);
}
#endif
