// SPDX-License-Identifier: Apache-2.0
/* Sums of Gaussian kernels over many anchors, on a CPU. Called by kernel_tree.py; kernel_sums.py works without it too.

Anchors lie in the leaves of a k-d tree. Queries are sorted into groups of neighbours. Each group walks down the tree
once, nearer child first, and skips each node that is too far away to count for any of its queries. A query keeps its
sums relative to the kernel of the nearest anchor seen so far, as attention does, so that they neither overflow nor
vanish. Distances come from differences, not from |q|^2 - 2 q.x + |x|^2, so that single precision is enough.

A dimension may be an angle. Then positions lie within half a period of zero, and so do differences: only the nearest
image of an anchor counts. The code for angles, and that for labels of anchors, is compiled apart from the ordinary one.
*/

#define _GNU_SOURCE /* RTLD_DEFAULT */
#define Py_LIMITED_API 0x030C0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <dlfcn.h>
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum {
    INTERFACE = 2, /* counts changes of what Python calls here; kernel_tree.py names the one that it needs */
    LANES = 16,    /* floats in one vector */
    VECTORS = 4,
    WIDTH = VECTORS * LANES, /* anchors of one leaf */
    GROUP = 16,              /* queries that walk together */
    MAX_DEPTH = 64,
    LEAVES_IN_SINGLE = 64, /* leaves added up in single precision before they are added to the totals */
    SAMPLED = 64,          /* points that decide along which dimension a set is split */
    SLICE = 256,           /* queries in one go, if there are enough of them for all threads */
    SLICES_PER_THREAD = 8, /* at most, as some take longer */
    WORK = 1 << 20,        /* queries x anchors x dimensions that are worth a thread's while */
};

typedef float Lanes __attribute__((vector_size(4 * LANES)));
typedef float LooseLanes __attribute__((vector_size(4 * LANES), aligned(4)));
typedef int32_t Integers __attribute__((vector_size(4 * LANES)));
typedef int32_t LooseIntegers __attribute__((vector_size(4 * LANES), aligned(4)));

#define INLINE static inline __attribute__((always_inline))

/* Compiles one variant for each kind of processor. The fitting one is chosen when the module is loaded. */
#if !defined(__x86_64__) || !defined(__GLIBC__)
#define FOR_EACH_PROCESSOR
#elif !defined(__clang__) && __GNUC__ >= 12
#define FOR_EACH_PROCESSOR __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define FOR_EACH_PROCESSOR __attribute__((target_clones("avx512f", "avx2", "default")))
#endif

/* Coordinates of queries are clamped to FARTHEST. Slots of a leaf without an anchor lie further out. Log sums are at
   least -LARGEST. */
static const float FARTHEST = 5e17f, LARGEST = 3e38f;

/* Squared distances are smaller than this in each dimension, and larger to slots without an anchor. */
static const float NO_ANCHOR = 1e37f;

/* Relative safety margin of bounds against rounding. */
static const float MARGIN = 5e-7f;

typedef struct {
    const float *leaves; /* (L, D, WIDTH); leaf i is node L - 1 + i */
    const float *boxes;  /* (2 L - 1, 2, D) corners; node k has the children 2 k + 1 and 2 k + 2 */
    const float *centre; /* (D,) origin of leaves and boxes */
    const float *periods;  /* (D,) of angles, 0 for other dimensions; NULL if there are no angles */
    const int32_t *labels; /* (L, WIDTH) of the anchors; only for the aim OTHERS */
    Py_ssize_t n_leaves, dim;
    float exponent_per_square; /* log2(e) / 2h^2: times a squared distance, it is a kernel's negative exponent of 2 */
    float exponent_range;      /* kernels smaller than the nearest anchor's by more powers of two are left out */
} Tree;

typedef struct {
    Py_ssize_t size;
    float *positions;  /* (G, D) relative to the centre */
    float *low, *high; /* (D,) corners of the box around them; an angle in it may be up to a period from zero */
    float *halves;     /* (D,) half the periods of angles, infinite for other dimensions */
    int32_t *labels;   /* (G,) only for the aim OTHERS */
    float *nearest;    /* (G,) squared distances to the nearest anchor seen so far */
    float *offsets;    /* (G, D) to that anchor; only for the aim NEAREST */
    Lanes *sums;       /* (G, 1 + D) of kernels, and of kernels times offsets, each relative to the nearest anchor's */
    double *totals;    /* (G, 1 + D) of what left `sums` */
    int *n_leaves;     /* (G,) that `sums` holds */
} Group;

/* The wanted result: the sums, or only the nearest anchor, or the sum of kernels and the distance to the nearest anchor
   among those whose label differs by more than 1 from the query's. */
typedef enum { SUMS, NEAREST, OTHERS } Aim;

/* ---- Sorting points into groups of neighbours -------------------------------------------------------------------- */

static Py_ssize_t widest_dimension(const float *points, Py_ssize_t dim, const int64_t *order, Py_ssize_t n) {
    Py_ssize_t widest = 0, stride = n / SAMPLED + 1;
    float largest = -1.0f;
    for (Py_ssize_t d = 0; d < dim; d++) {
        float low = INFINITY, high = -INFINITY;
        for (Py_ssize_t i = 0; i < n; i += stride) {
            const float x = points[order[i] * dim + d];
            low = x < low ? x : low;
            high = x > high ? x : high;
        }
        if (high - low > largest) {
            largest = high - low;
            widest = d;
        }
    }
    return widest;
}

/* Reorders so that no key before index k is larger than one after it (Hoare's selection). */
static void partition_at(const float *keys, Py_ssize_t dim, int64_t *order, Py_ssize_t n, Py_ssize_t k) {
    Py_ssize_t first = 0, last = n - 1;
    while (first < last) {
        const float pivot = keys[order[first + (last - first) / 2] * dim];
        Py_ssize_t i = first, j = last;
        while (i <= j) {
            while (keys[order[i] * dim] < pivot) i++;
            while (keys[order[j] * dim] > pivot) j--;
            if (i <= j) {
                const int64_t other = order[i];
                order[i++] = order[j];
                order[j--] = other;
            }
        }
        if (k <= j)
            last = j;
        else if (k >= i)
            first = i;
        else
            return;
    }
}

/* The number of leaves left of the root, in a binary tree of n leaves that is full except for its last level. */
static Py_ssize_t left_of(Py_ssize_t n_leaves) {
    Py_ssize_t full = 1;
    while (2 * full <= n_leaves) full *= 2;
    const Py_ssize_t half = full / 2 + n_leaves - full;
    return half < full ? half : full;
}

/* Orders points so that each run of `size` successive points is a leaf of such a tree. The last leaf may be smaller. */
static void sort(const float *points, Py_ssize_t dim, int64_t *order, Py_ssize_t n, Py_ssize_t size) {
    while (n > size) {
        const Py_ssize_t half = left_of((n + size - 1) / size) * size;
        partition_at(points + widest_dimension(points, dim, order, n), dim, order, n, half);
        sort(points, dim, order + half, n - half, size);
        n = half;
    }
}

/* ---- Angles ------------------------------------------------------------------------------------------------------ */

/* An angle brought within half a period of zero. It costs no digits. */
static float wrapped(float x, float period) {
    if (fabsf(x) <= period / 2) return x;
    return remainderf(x < -FLT_MAX ? -FLT_MAX : x > FLT_MAX ? FLT_MAX : x, period);
}

/* x - q, for angles to the nearest image of x. `halves` are half periods, infinite for other dimensions; NULL if there
   are no angles. Half a period is taken from each of x and q: their difference is close to a whole period where the
   images are close to each other, so it would lose their digits. */
INLINE float offset_to(float x, float q, const float *halves, Py_ssize_t d) {
    const float offset = x - q;
    if (!halves || !(fabsf(offset) > halves[d])) return offset;
    const float half = copysignf(halves[d], offset);
    return (x - half) - (q + half);
}

/* ---- Kernels of one query and the anchors of one leaf ------------------------------------------------------------ */

INLINE Lanes load(const float *address) { return *(const LooseLanes *)address; }

/* What `offset_to` returns, for the anchors from `address` on. */
INLINE Lanes offsets_to(const float *address, float q, const float *halves, Py_ssize_t d) {
    const Lanes x = load(address);
    if (!halves) return x - q;
    const Lanes offset = x - q, half = halves[d] - (Lanes){0};
    const Integers sign = (Integers)offset & INT32_MIN, size = (Integers)offset & INT32_MAX;
    const Integers is_wide = (Lanes)size > half;
    const Lanes shift = (Lanes)(is_wide & ((Integers)half | sign));
    return (x - shift) - (q + shift);
}

INLINE Lanes lower(Lanes a, Lanes b) {
    const Integers is_lower = a < b;
    return (Lanes)((is_lower & (Integers)a) | (~is_lower & (Integers)b));
}

INLINE float lowest(Lanes a) {
    float lanes[LANES];
    memcpy(lanes, &a, sizeof a);
    for (int half = LANES / 2; half; half /= 2)
        for (int i = 0; i < half; i++) lanes[i] = lanes[i] < lanes[i + half] ? lanes[i] : lanes[i + half];
    return lanes[0];
}

INLINE float sum(Lanes a) {
    float lanes[LANES];
    memcpy(lanes, &a, sizeof a);
    for (int half = LANES / 2; half; half /= 2)
        for (int i = 0; i < half; i++) lanes[i] += lanes[i + half];
    return lanes[0];
}

/* 2^x for x <= 0, with a relative error of 1e-7; 0 below 2^-125. */
INLINE Lanes power_of_two(Lanes x) {
    const float smallest = -125.0f;
    const Integers is_zero = x < smallest;
    const Lanes in_range = (Lanes)((~is_zero & (Integers)x));
    const Lanes shifted = in_range + 12582912.0f; /* 1.5 * 2^23: the last digit is worth 1 */
    const Lanes f = in_range - (shifted - 12582912.0f);
    /* The polynomial of least relative error for 2^f in [-1/2, 1/2]. */
    Lanes p = 0.001327647129073739f * f + 0.009675540961325169f;
    p = p * f + 0.05550713092088699f;
    p = p * f + 0.24022120237350464f;
    p = p * f + 0.6931469440460205f;
    p = p * f + 1.0000001192092896f;
    const Integers power = (Integers)p + ((Integers)shifted << 23);
    return (Lanes)(~is_zero & power);
}

INLINE void move_to_totals(Group *group, Py_ssize_t i, Py_ssize_t dim) {
    const Lanes zero = {0};
    for (Py_ssize_t d = 0; d <= dim; d++) {
        group->totals[i * (1 + dim) + d] += sum(group->sums[i * (1 + dim) + d]);
        group->sums[i * (1 + dim) + d] = zero;
    }
    group->n_leaves[i] = 0;
}

INLINE void distances(
    const float *leaf, const float *q, const float *halves, const Py_ssize_t dim, Lanes squares[VECTORS]
) {
    for (int v = 0; v < VECTORS; v++) squares[v] = (Lanes){0};
    for (Py_ssize_t d = 0; d < dim; d++)
        for (int v = 0; v < VECTORS; v++) {
            const Lanes offset = offsets_to(leaf + d * WIDTH + v * LANES, q[d], halves, d);
            squares[v] += offset * offset;
        }
}

/* Makes the squared distances to the anchors infinite whose label differs by at most 1 from the query's. */
INLINE void leave_out(const int32_t *labels, int32_t label, Lanes squares[VECTORS]) {
    const float infinity = INFINITY;
    const Integers infinite = (Integers)(infinity - (Lanes){0});
    for (int v = 0; v < VECTORS; v++) {
        const Integers of_anchors = *(const LooseIntegers *)(labels + v * LANES);
        const Integers is_left_out = (of_anchors >= label - 1) & (of_anchors <= label + 1);
        squares[v] = (Lanes)((is_left_out & infinite) | (~is_left_out & (Integers)squares[v]));
    }
}

INLINE void add_kernels(
    const Tree *tree, const float *leaf, Group *group, Py_ssize_t i, const Lanes squares[VECTORS],
    const float *halves, const Py_ssize_t dim, const Aim aim
) {
    const float *q = group->positions + i * dim;
    Lanes *sums = group->sums + i * (1 + dim);
    Lanes weights[VECTORS];
    for (int v = 0; v < VECTORS; v++) {
        weights[v] = power_of_two(tree->exponent_per_square * (group->nearest[i] - squares[v]));
        sums[0] += weights[v];
    }
    for (Py_ssize_t d = 0; aim == SUMS && d < dim; d++) {
        Lanes shift = sums[1 + d];
        for (int v = 0; v < VECTORS; v++)
            shift += weights[v] * offsets_to(leaf + d * WIDTH + v * LANES, q[d], halves, d);
        sums[1 + d] = shift;
    }
    if (++group->n_leaves[i] == LEAVES_IN_SINGLE) move_to_totals(group, i, dim);
}

INLINE void shrink(Group *group, Py_ssize_t i, float factor, const Py_ssize_t dim) {
    for (Py_ssize_t d = i * (1 + dim); d < (i + 1) * (1 + dim); d++) {
        group->sums[d] *= factor;
        group->totals[d] *= factor;
    }
}

/* Stores the offset to the anchor of this leaf that is nearest to query i. */
INLINE void store_offset(
    const float *leaf, Group *group, Py_ssize_t i, const Lanes squares[VECTORS], const float *halves,
    const Py_ssize_t dim
) {
    float flat[WIDTH];
    memcpy(flat, squares, sizeof flat);
    int slot = 0;
    while (slot < WIDTH - 1 && flat[slot] != group->nearest[i]) slot++;
    for (Py_ssize_t d = 0; d < dim; d++)
        group->offsets[i * dim + d] = offset_to(leaf[d * WIDTH + slot], group->positions[i * dim + d], halves, d);
}

INLINE void visit_leaf(
    const Tree *tree, Py_ssize_t leaf_index, Group *group, Py_ssize_t i, const float *halves, const Py_ssize_t dim,
    const Aim aim
) {
    const float *leaf = tree->leaves + leaf_index * dim * WIDTH;
    Lanes squares[VECTORS];
    distances(leaf, group->positions + i * dim, halves, dim, squares);
    if (aim == OTHERS) leave_out(tree->labels + leaf_index * WIDTH, group->labels[i], squares);
    Lanes least = squares[0];
    for (int v = 1; v < VECTORS; v++) least = lower(least, squares[v]);
    const float nearest = lowest(least), before = group->nearest[i];
    if (aim == OTHERS && nearest >= dim * NO_ANCHOR) return;
    if (nearest < before) {
        group->nearest[i] = nearest;
        if (aim == NEAREST)
            store_offset(leaf, group, i, squares, halves, dim);
        else
            shrink(group, i, exp2f(tree->exponent_per_square * (nearest - before)), dim);
    }
    const int counts = !(tree->exponent_per_square * (nearest - before) > tree->exponent_range);
    if (aim != NEAREST && counts) add_kernels(tree, leaf, group, i, squares, halves, dim, aim);
}

/* ---- Walking down the tree --------------------------------------------------------------------------------------- */

/* The squared distance between two boxes, or less. */
INLINE float gap(
    const float *low, const float *high, const float *box, const float *halves, const Py_ssize_t dim
) {
    float square = 0.0f;
    for (Py_ssize_t d = 0; d < dim; d++) {
        const float below = box[d] - high[d], above = low[d] - box[dim + d];
        float distance = below > above ? below : above;
        if (halves) { /* the other way round */
            const float other = 2.0f * (1.0f - MARGIN) * halves[d] + (below > above ? above : below);
            distance = other < distance ? other : distance;
        }
        square += distance > 0.0f ? distance * distance : 0.0f;
    }
    return square;
}

INLINE void walk(const Tree *tree, Group *group, const Py_ssize_t dim, const Aim aim, const int has_angles) {
    const float exponent_range = aim == NEAREST ? 0.0f : tree->exponent_range;
    const float *halves = has_angles ? group->halves : NULL;
    struct {
        Py_ssize_t node;
        float square;
    } todo[MAX_DEPTH] = {{0, 0.0f}};
    float farthest = INFINITY; /* of the queries' nearest anchors */
    for (int n_todo = 1; n_todo;) {
        const Py_ssize_t node = todo[--n_todo].node;
        if (tree->exponent_per_square * (todo[n_todo].square - farthest) > exponent_range) continue;
        if (node < tree->n_leaves - 1) {
            Py_ssize_t near = 2 * node + 1, far = near + 1;
            float near_square = gap(group->low, group->high, tree->boxes + near * 2 * dim, halves, dim);
            float far_square = gap(group->low, group->high, tree->boxes + far * 2 * dim, halves, dim);
            if (far_square < near_square) {
                const float square = near_square;
                near_square = far_square, far_square = square;
                near = far, far = 2 * node + 1;
            }
            todo[n_todo].node = far, todo[n_todo++].square = far_square;
            todo[n_todo].node = near, todo[n_todo++].square = near_square;
            continue;
        }
        const Py_ssize_t leaf = node - (tree->n_leaves - 1);
        const float *box = tree->boxes + node * 2 * dim;
        farthest = 0.0f;
        for (Py_ssize_t i = 0; i < group->size; i++) {
            const float *q = group->positions + i * dim;
            if (!(tree->exponent_per_square * (gap(q, q, box, halves, dim) - group->nearest[i]) > exponent_range))
                visit_leaf(tree, leaf, group, i, halves, dim, aim);
            farthest = group->nearest[i] > farthest ? group->nearest[i] : farthest;
        }
    }
}

FOR_EACH_PROCESSOR static void sum_up(const Tree *tree, Group *group) {
    switch (tree->dim) { /* loops of a known length are unrolled */
    case 1: walk(tree, group, 1, SUMS, 0); break;
    case 2: walk(tree, group, 2, SUMS, 0); break;
    case 3: walk(tree, group, 3, SUMS, 0); break;
    case 4: walk(tree, group, 4, SUMS, 0); break;
    default: walk(tree, group, tree->dim, SUMS, 0);
    }
}

FOR_EACH_PROCESSOR static void sum_up_with_angles(const Tree *tree, Group *group) {
    walk(tree, group, tree->dim, SUMS, 1);
}

FOR_EACH_PROCESSOR static void sum_up_others(const Tree *tree, Group *group) {
    walk(tree, group, tree->dim, OTHERS, 0);
}

FOR_EACH_PROCESSOR static void sum_up_others_with_angles(const Tree *tree, Group *group) {
    walk(tree, group, tree->dim, OTHERS, 1);
}

FOR_EACH_PROCESSOR static void find_nearest(const Tree *tree, Group *group) {
    walk(tree, group, tree->dim, NEAREST, 0);
}

FOR_EACH_PROCESSOR static void find_nearest_with_angles(const Tree *tree, Group *group) {
    walk(tree, group, tree->dim, NEAREST, 1);
}

/* ---- Groups of queries ------------------------------------------------------------------------------------------- */

/* Extends the group's box by query i. Angles count from the first query on, so that a box across half a period from
   zero is as small as elsewhere. */
static void extend_box(Group *group, const float *periods, Py_ssize_t i, Py_ssize_t dim) {
    for (Py_ssize_t d = 0; d < dim; d++) {
        float x = group->positions[i * dim + d];
        if (periods && periods[d] > 0.0f) {
            const float from_first = x - group->positions[d], period = periods[d] * (1.0f + MARGIN);
            x = from_first > periods[d] / 2 ? x - period : from_first < -periods[d] / 2 ? x + period : x;
        }
        group->low[d] = x < group->low[d] ? x : group->low[d];
        group->high[d] = x > group->high[d] ? x : group->high[d];
    }
}

static void gather(Group *group, const Tree *tree, const float *queries, const int64_t *order, Py_ssize_t size) {
    const Py_ssize_t dim = tree->dim;
    group->size = size;
    for (Py_ssize_t d = 0; d < dim; d++) group->low[d] = INFINITY, group->high[d] = -INFINITY;
    for (Py_ssize_t i = 0; i < size; i++) {
        for (Py_ssize_t d = 0; d < dim; d++) {
            float x = queries[order[i] * dim + d] - tree->centre[d];
            if (tree->periods && tree->periods[d] > 0.0f) x = wrapped(x, tree->periods[d]);
            group->positions[i * dim + d] = x < -FARTHEST ? -FARTHEST : x > FARTHEST ? FARTHEST : x;
        }
        extend_box(group, tree->periods, i, dim);
        group->nearest[i] = INFINITY;
        group->n_leaves[i] = 0;
    }
    memset(group->offsets, 0, size * dim * sizeof *group->offsets);
    memset(group->sums, 0, size * (1 + dim) * sizeof *group->sums);
    memset(group->totals, 0, size * (1 + dim) * sizeof *group->totals);
}

static void scatter_sums(Group *group, const Tree *tree, const int64_t *order, float *offsets, float *log_sums) {
    const Py_ssize_t dim = tree->dim;
    for (Py_ssize_t i = 0; i < group->size; i++) {
        move_to_totals(group, i, dim);
        const double *totals = group->totals + i * (1 + dim);
        const double log_sum = log(totals[0]) - M_LN2 * tree->exponent_per_square * (double)group->nearest[i];
        log_sums[order[i]] = log_sum < -LARGEST ? -LARGEST : (float)log_sum;
        if (!offsets) continue;
        for (Py_ssize_t d = 0; d < dim; d++) offsets[order[i] * dim + d] = (float)(totals[1 + d] / totals[0]);
    }
}

/* The log sums and distances of the aim OTHERS. */
static void scatter_others(Group *group, const Tree *tree, const int64_t *order, float *distances, float *log_sums) {
    scatter_sums(group, tree, order, NULL, log_sums);
    for (Py_ssize_t i = 0; i < group->size; i++) {
        distances[order[i]] = isnan(log_sums[order[i]]) ? NAN : sqrtf(group->nearest[i]);
        if (distances[order[i]] == INFINITY) log_sums[order[i]] = -INFINITY; /* no anchor remains */
    }
}

static void scatter_offsets(const Group *group, Py_ssize_t dim, const int64_t *order, float *offsets) {
    for (Py_ssize_t i = 0; i < group->size; i++)
        memcpy(offsets + order[i] * dim, group->offsets + i * dim, dim * sizeof *offsets);
}

/* A computation for n of the queries. `order` holds their indices and is reordered. The result is log sums, and unless
   `offsets` is NULL the offsets to the local means. If `log_sums` is NULL, it is the offsets to the nearest anchor. If
   `distances` is not NULL, it is log sums and the distances to the nearest anchor, both without the anchors of the
   queries' own labels. */
typedef struct {
    const Tree *tree;
    const float *queries;
    const int32_t *labels;
    int64_t *order;
    Py_ssize_t n;
    float *offsets, *log_sums, *distances;
    Py_ssize_t n_slices, next_slice; /* each thread takes the next slice when it has finished one */
    int has_memory;
} Job;

static void do_group(const Job *job, Group *group, const int64_t *order) {
    const Tree *tree = job->tree;
    if (job->distances) {
        for (Py_ssize_t i = 0; i < group->size; i++) group->labels[i] = job->labels[order[i]];
        (tree->periods ? sum_up_others_with_angles : sum_up_others)(tree, group);
        scatter_others(group, tree, order, job->distances, job->log_sums);
    } else if (job->log_sums) {
        (tree->periods ? sum_up_with_angles : sum_up)(tree, group);
        scatter_sums(group, tree, order, job->offsets, job->log_sums);
    } else {
        (tree->periods ? find_nearest_with_angles : find_nearest)(tree, group);
        scatter_offsets(group, tree->dim, order, job->offsets);
    }
}

static int do_slice(const Job *job, int64_t *order, Py_ssize_t n) {
    const Tree *tree = job->tree;
    const Py_ssize_t dim = tree->dim, row = GROUP * (1 + dim);
    Lanes *sums = aligned_alloc(sizeof(Lanes), row * sizeof(Lanes));
    double *totals = malloc(row * sizeof *totals);
    float *floats = malloc((2 * GROUP * dim + 3 * dim + GROUP) * sizeof *floats);
    int n_in_sums[GROUP];
    int32_t labels[GROUP];
    const int has_memory = sums && totals && floats;
    if (has_memory) {
        Group group = {
            .sums = sums, .totals = totals, .n_leaves = n_in_sums, .labels = labels, .positions = floats
        };
        group.offsets = group.positions + GROUP * dim;
        group.low = group.offsets + GROUP * dim;
        group.high = group.low + dim;
        group.halves = group.high + dim;
        group.nearest = group.halves + dim;
        for (Py_ssize_t d = 0; tree->periods && d < dim; d++)
            group.halves[d] = tree->periods[d] > 0.0f ? tree->periods[d] / 2 : INFINITY;
        sort(job->queries, dim, order, n, GROUP);
        for (Py_ssize_t i = 0; i < n; i += GROUP) {
            gather(&group, tree, job->queries, order + i, n - i < GROUP ? n - i : GROUP);
            do_group(job, &group, order + i);
        }
    }
    free(sums), free(totals), free(floats);
    return has_memory;
}

static void do_slices(void *pointer) {
    Job *job = pointer;
    Py_ssize_t slice;
    while ((slice = __atomic_fetch_add(&job->next_slice, 1, __ATOMIC_RELAXED)) < job->n_slices) {
        const Py_ssize_t start = slice * job->n / job->n_slices, end = (slice + 1) * job->n / job->n_slices;
        if (!do_slice(job, job->order + start, end - start)) __atomic_store_n(&job->has_memory, 0, __ATOMIC_RELAXED);
    }
}

static Py_ssize_t smaller(Py_ssize_t a, Py_ssize_t b) { return a < b ? a : b; }

/* The number of slices that are worth the overhead; each has at least one group. */
static Py_ssize_t n_slices_of(const Job *job, int n_threads) {
    const double work = (double)job->n * job->tree->n_leaves * WIDTH * job->tree->dim / WORK;
    Py_ssize_t n_slices = 1 + job->n / SLICE;
    if (n_slices < n_threads) n_slices = n_threads;
    n_slices = smaller(n_slices, smaller(n_threads * SLICES_PER_THREAD, job->n / GROUP));
    if (n_slices > work) n_slices = (Py_ssize_t)work;
    return n_slices > 1 ? n_slices : 1;
}

/* Returns false if memory runs out. The threads are those of PyTorch's OpenMP. Other threads would compete with them
   for the cores, because OpenMP threads keep spinning for a while after their work. */
static int do_job(Job *job, int n_threads) {
    typedef void Parallel(void (*)(void *), void *, unsigned, unsigned);
    Parallel *parallel = NULL;
    job->has_memory = 1;
    job->n_slices = n_threads > 1 ? n_slices_of(job, n_threads) : 1;
    if (job->n_slices > 1) *(void **)&parallel = dlsym(RTLD_DEFAULT, "GOMP_parallel");
    if (parallel) {
        parallel(do_slices, job, n_threads, 0);
    } else {
        do_slices(job);
    }
    return job->has_memory;
}

static int64_t *indices(Py_ssize_t n) {
    int64_t *order = malloc((n + 1) * sizeof *order);
    for (Py_ssize_t i = 0; order && i < n; i++) order[i] = i;
    return order;
}

static int sum_all(
    const Tree *tree, const float *queries, Py_ssize_t n, float *offsets, float *log_sums, int n_threads
) {
    Job job = {.tree = tree, .queries = queries, .order = indices(n), .n = n, .offsets = offsets, .log_sums = log_sums};
    const int has_memory = job.order && do_job(&job, n_threads);
    free(job.order);
    return has_memory;
}

static int sum_all_others(
    const Tree *tree, const float *queries, const int32_t *labels, Py_ssize_t n, float *log_sums, float *distances,
    int n_threads
) {
    Job job = {
        .tree = tree, .queries = queries, .labels = labels, .order = indices(n), .n = n, .log_sums = log_sums,
        .distances = distances,
    };
    const int has_memory = job.order && do_job(&job, n_threads);
    free(job.order);
    return has_memory;
}

/* Keeps those of n indices whose value is not above the threshold; returns their number. */
static Py_ssize_t keep_low(int64_t *order, Py_ssize_t n, const float *values, float threshold) {
    Py_ssize_t n_kept = 0;
    for (Py_ssize_t i = 0; i < n; i++)
        if (!(values[order[i]] > threshold)) order[n_kept++] = order[i];
    return n_kept;
}

/* Offsets to the nearest target for queries whose log sum is not above the threshold; zero for the others. `at_least`
   holds known lower bounds of the log sums, or is NULL. Returns false if memory runs out. */
static int lead_all_to_targets(
    const Tree *tree, const Tree *targets, const float *queries, Py_ssize_t n, const float *at_least, float threshold,
    float *offsets, int n_threads
) {
    float *log_sums = malloc((n + 1) * sizeof *log_sums);
    Job look = {.tree = tree, .queries = queries, .order = indices(n), .n = n, .log_sums = log_sums};
    int has_memory = look.order && log_sums;
    memset(offsets, 0, n * tree->dim * sizeof *offsets);
    if (has_memory) {
        if (at_least) look.n = keep_low(look.order, n, at_least, threshold);
        has_memory = do_job(&look, n_threads);
    }
    if (has_memory) {
        Job lead = {.tree = targets, .queries = queries, .order = look.order, .offsets = offsets};
        lead.n = keep_low(look.order, look.n, log_sums, threshold);
        has_memory = do_job(&lead, n_threads);
    }
    free(look.order), free(log_sums);
    return has_memory;
}

/* How strongly a density pulls: fully where its logarithm is at most `log_none - width`, not at all from `log_none` on. */
typedef struct {
    float log_normaliser; /* log density = log sum - log_normaliser */
    float log_none, width;
} Pull;

/* The same operations in the same order as `Pull.weight`, so that both decide alike. NaN stays NaN. */
static float weight_at(const Pull *pull, float log_sum) {
    const float weight = (pull->log_none - (log_sum - pull->log_normaliser)) / pull->width;
    return weight > 1.0f ? 1.0f : weight < 0.0f ? 0.0f : weight;
}

/* Steps that cover a `share` of the offset to the local mean, times the weight of the pull. Where the log sum there is
   not above the threshold, they go on towards the nearest target, by at most `max_distance`. Returns false if memory
   runs out. */
static int step_all_to_targets(
    const Tree *tree, const Tree *targets, const float *queries, Py_ssize_t n, float threshold, float share,
    float max_distance, const Pull *pull, float *steps, int n_threads
) {
    const Py_ssize_t dim = tree->dim;
    float *log_sums = malloc((n + 1) * sizeof *log_sums);
    float *shifted = malloc((n * dim + 1) * sizeof *shifted), *offsets = malloc((n * dim + 1) * sizeof *offsets);
    int has_memory = log_sums && shifted && offsets && sum_all(tree, queries, n, steps, log_sums, n_threads);
    if (has_memory) {
        for (Py_ssize_t i = 0; i < n; i++) {
            const float own_share = share * weight_at(pull, log_sums[i]);
            const double gain = own_share * (2.0 - own_share) * M_LN2 * tree->exponent_per_square;
            double square = 0.0;
            for (Py_ssize_t d = i * dim; d < (i + 1) * dim; d++) {
                square += (double)steps[d] * steps[d];
                steps[d] *= own_share;
                shifted[d] = queries[d] + steps[d];
            }
            /* A mean shift raises the log density by at least this (Comaniciu and Meer 2002, Theorem 1). With angles
               this holds for the images that were nearest before; other ones raise it further. */
            log_sums[i] = (float)(log_sums[i] + gain * square);
        }
    }
    const int goes_on = max_distance > 0.0f;
    if (has_memory && goes_on)
        has_memory = lead_all_to_targets(tree, targets, shifted, n, log_sums, threshold, offsets, n_threads);
    for (Py_ssize_t i = 0; has_memory && goes_on && i < n; i++) {
        double square = 0.0;
        for (Py_ssize_t d = i * dim; d < (i + 1) * dim; d++) square += (double)offsets[d] * offsets[d];
        const int is_far = square > (double)max_distance * max_distance;
        const float factor = is_far ? (float)(max_distance / sqrt(square)) : 1.0f;
        for (Py_ssize_t d = i * dim; d < (i + 1) * dim; d++) steps[d] += factor * offsets[d];
    }
    free(log_sums), free(shifted), free(offsets);
    return has_memory;
}

/* ---- For Python -------------------------------------------------------------------------------------------------- */

/* A tree as Python holds it: (leaves, boxes, centre, periods, exponent_per_square, exponent_range). `periods` is empty
   if there are no angles. */
typedef struct {
    Py_buffer leaves, boxes, centre, periods;
    float exponent_per_square, exponent_range;
} HeldTree;

/* False, with an error of Python, if the tuple holds something else. A tree is read by a call of its own:
   PyArg_ParseTuple has room for as many buffers as its own arguments, or 8, and does not count those in tuples. */
static int hold(PyObject *tuple, HeldTree *held) {
    return PyArg_ParseTuple(
        tuple, "y*y*y*y*ff", &held->leaves, &held->boxes, &held->centre, &held->periods, &held->exponent_per_square,
        &held->exponent_range
    );
}

/* Nothing happens if it was not held. */
static void release(HeldTree *held) {
    PyBuffer_Release(&held->leaves), PyBuffer_Release(&held->boxes);
    PyBuffer_Release(&held->centre), PyBuffer_Release(&held->periods);
}

static Py_ssize_t n_floats(const Py_buffer *buffer) { return buffer->len / sizeof(float); }

/* False if the sizes do not fit. */
static int read_tree(const HeldTree *held, Tree *tree) {
    const Py_ssize_t dim = n_floats(&held->centre), n_nodes = dim ? n_floats(&held->boxes) / (2 * dim) : 0;
    *tree = (Tree){
        .leaves = held->leaves.buf, .boxes = held->boxes.buf, .centre = held->centre.buf,
        .periods = held->periods.len ? held->periods.buf : NULL, .n_leaves = (n_nodes + 1) / 2, .dim = dim,
        .exponent_per_square = held->exponent_per_square, .exponent_range = held->exponent_range,
    };
    return n_nodes % 2 && n_floats(&held->boxes) == n_nodes * 2 * dim
        && n_floats(&held->leaves) == tree->n_leaves * dim * WIDTH
        && (!held->periods.len || n_floats(&held->periods) == dim);
}

static PyObject *answer(int fits, int has_memory) {
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "the arrays' sizes do not fit");
        return NULL;
    }
    if (!has_memory) return PyErr_NoMemory();
    Py_RETURN_NONE;
}

static PyObject *order_points(PyObject *module, PyObject *args) {
    Py_buffer points, order;
    if (!PyArg_ParseTuple(args, "y*w*", &points, &order)) return NULL;
    const Py_ssize_t n = order.len / sizeof(int64_t);
    const int fits = n > 0 && n_floats(&points) > 0 && n_floats(&points) % n == 0;
    if (fits) {
        Py_BEGIN_ALLOW_THREADS;
        int64_t *indices = order.buf;
        for (Py_ssize_t i = 0; i < n; i++) indices[i] = i;
        sort(points.buf, n_floats(&points) / n, indices, n, WIDTH);
        Py_END_ALLOW_THREADS;
    }
    PyBuffer_Release(&points), PyBuffer_Release(&order);
    return answer(fits, 1);
}

static PyObject *sum_kernels(PyObject *module, PyObject *args) {
    PyObject *tuple;
    HeldTree held = {0};
    Py_buffer queries, offsets, log_sums;
    int n_threads;
    Tree tree;
    if (!PyArg_ParseTuple(args, "O!y*w*w*i", &PyTuple_Type, &tuple, &queries, &offsets, &log_sums, &n_threads))
        return NULL;
    const int is_held = hold(tuple, &held);
    const Py_ssize_t n = n_floats(&log_sums);
    const int fits = is_held && read_tree(&held, &tree) && n_floats(&queries) == n * tree.dim
        && offsets.len == queries.len;
    int has_memory = 1;
    if (fits) {
        Py_BEGIN_ALLOW_THREADS;
        has_memory = sum_all(&tree, queries.buf, n, offsets.buf, log_sums.buf, n_threads);
        Py_END_ALLOW_THREADS;
    }
    release(&held), PyBuffer_Release(&queries), PyBuffer_Release(&offsets), PyBuffer_Release(&log_sums);
    return is_held ? answer(fits, has_memory) : NULL;
}

static PyObject *sum_other_kernels(PyObject *module, PyObject *args) {
    PyObject *tuple;
    HeldTree held = {0};
    Py_buffer labels, queries, query_labels, log_sums, distances;
    int n_threads;
    Tree tree;
    if (!PyArg_ParseTuple(
            args, "O!y*y*y*w*w*i", &PyTuple_Type, &tuple, &labels, &queries, &query_labels, &log_sums, &distances,
            &n_threads
        ))
        return NULL;
    const int is_held = hold(tuple, &held);
    const Py_ssize_t n = n_floats(&log_sums);
    const int fits = is_held && read_tree(&held, &tree)
        && labels.len == tree.n_leaves * WIDTH * (Py_ssize_t)sizeof(int32_t)
        && n_floats(&queries) == n * tree.dim && query_labels.len == n * (Py_ssize_t)sizeof(int32_t)
        && distances.len == log_sums.len;
    int has_memory = 1;
    if (fits) {
        Py_BEGIN_ALLOW_THREADS;
        tree.labels = labels.buf;
        has_memory = sum_all_others(
            &tree, queries.buf, query_labels.buf, n, log_sums.buf, distances.buf, n_threads
        );
        Py_END_ALLOW_THREADS;
    }
    release(&held), PyBuffer_Release(&labels), PyBuffer_Release(&queries), PyBuffer_Release(&query_labels);
    PyBuffer_Release(&log_sums), PyBuffer_Release(&distances);
    return is_held ? answer(fits, has_memory) : NULL;
}

/* The arguments that the two functions below share. */
typedef struct {
    PyObject *tuple, *target_tuple;
    HeldTree held, held_targets;
    Tree tree, targets;
    Py_buffer queries, result;
    Py_ssize_t n;
    int is_held;
} Request;

#define TREES "O!O!"
#define POINTERS_TO_TREES(request) &PyTuple_Type, &(request).tuple, &PyTuple_Type, &(request).target_tuple

static int read_request(Request *request) {
    request->is_held = hold(request->tuple, &request->held) && hold(request->target_tuple, &request->held_targets);
    const int fits = request->is_held && read_tree(&request->held, &request->tree)
        && read_tree(&request->held_targets, &request->targets) && request->tree.dim == request->targets.dim
        && n_floats(&request->queries) % request->tree.dim == 0
        && request->result.len == request->queries.len;
    request->n = fits ? n_floats(&request->queries) / request->tree.dim : 0;
    return fits;
}

static void release_request(Request *request) {
    release(&request->held), release(&request->held_targets);
    PyBuffer_Release(&request->queries), PyBuffer_Release(&request->result);
}

static PyObject *answer_request(const Request *request, int fits, int has_memory) {
    return request->is_held ? answer(fits, has_memory) : NULL;
}

static PyObject *lead_to_targets(PyObject *module, PyObject *args) {
    Request request = {0};
    float threshold;
    int n_threads, has_memory = 1;
    if (!PyArg_ParseTuple(
            args, TREES "y*fw*i", POINTERS_TO_TREES(request), &request.queries, &threshold, &request.result, &n_threads
        ))
        return NULL;
    const int fits = read_request(&request);
    if (fits) {
        Py_BEGIN_ALLOW_THREADS;
        has_memory = lead_all_to_targets(
            &request.tree, &request.targets, request.queries.buf, request.n, NULL, threshold,
            request.result.buf, n_threads
        );
        Py_END_ALLOW_THREADS;
    }
    release_request(&request);
    return answer_request(&request, fits, has_memory);
}

static PyObject *step_to_targets(PyObject *module, PyObject *args) {
    Request request = {0};
    float threshold, share, max_distance;
    Pull pull;
    int n_threads, has_memory = 1;
    if (!PyArg_ParseTuple(
            args, TREES "y*fff(fff)w*i", POINTERS_TO_TREES(request), &request.queries, &threshold, &share,
            &max_distance, &pull.log_normaliser, &pull.log_none, &pull.width, &request.result, &n_threads
        ))
        return NULL;
    const int fits = read_request(&request);
    if (fits) {
        Py_BEGIN_ALLOW_THREADS;
        has_memory = step_all_to_targets(
            &request.tree, &request.targets, request.queries.buf, request.n, threshold, share, max_distance, &pull,
            request.result.buf, n_threads
        );
        Py_END_ALLOW_THREADS;
    }
    release_request(&request);
    return answer_request(&request, fits, has_memory);
}

static PyMethodDef methods[] = {
    {"order_points", order_points, METH_VARARGS, "Sorts points into leaves."},
    {"sum_kernels", sum_kernels, METH_VARARGS, "The offsets to local means, and the logarithms of the sums."},
    {"sum_other_kernels", sum_other_kernels, METH_VARARGS, "The same without some anchors, and distances."},
    {"lead_to_targets", lead_to_targets, METH_VARARGS, "The offsets to the nearest target where the log sum is low."},
    {"step_to_targets", step_to_targets, METH_VARARGS, "The steps to local means and, at a low log sum, to targets."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_kernel_tree", "Sums of Gaussian kernels on a CPU.", -1, methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__kernel_tree(void) {
    PyObject *created = PyModule_Create(&module);
    if (created && PyModule_AddIntConstant(created, "LEAF_SIZE", WIDTH) < 0) Py_CLEAR(created);
    if (created && PyModule_AddIntConstant(created, "INTERFACE", INTERFACE) < 0) Py_CLEAR(created);
    return created;
}
