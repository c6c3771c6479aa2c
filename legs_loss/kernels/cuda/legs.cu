// The weighted L1 and SSIM, value and gradient, in one pass. For NVRTC: no includes, C++14.
//
// Compiled with -DVALUE=0|1|2 (images of float32, float16, bfloat16), -DSTENCIL=0|FOUR|EIGHT|GRADIENT (weights from a map
// or none; from the target's response to a Laplacian of 4 neighbours, of 8, a gradient) and -DNORM=1|2|3 (the norm over
// channels: 1, 2, infinity). a * b + c is rounded twice unless fmaf says otherwise (--fmad=false), so that every compiler
// gives the same bits. modules.py puts in front what it makes of the package's tables: the kinds of stencils, and CURVES,
// of each curve CURVE(its number, its formula of x).
//
// A block is a sequence of phases. Within one no thread reads what another writes; between two all threads wait. So the
// same source runs on a CPU, as a loop over the threads of each phase (tests/cuda_emulation).

#ifndef EMULATED
#define DEVICE __device__ __forceinline__
#define SHARED __shared__ __align__(16)
#define KERNEL(name, least_blocks) extern "C" __global__ void __launch_bounds__(THREADS, least_blocks) name(const Task k)
#define BLOCK ((long long)blockIdx.x)
#define BLOCKS ((long long)gridDim.x)
#define LANES(type, name) type name
#define THREADS 256
template <class Lane, class Body>
DEVICE void phase(Lane& lane, Body body) {
    body(lane, (int)threadIdx.x);
    __syncthreads();
}
DEVICE float half_to_float(unsigned short bits) {
    float value;
    asm("cvt.f32.f16 %0, %1;" : "=f"(value) : "h"(bits));
    return value;
}
DEVICE unsigned short float_to_half(float value) {
    unsigned short bits;
    asm("cvt.rn.f16.f32 %0, %1;" : "=h"(bits) : "f"(value));
    return bits;
}
DEVICE float rough_reciprocal(float x) {  // 1 ulp; no path for subnormal numbers
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
}
DEVICE float root(float x) {  // 1 ulp; subnormal numbers are 0
    float y;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
}
DEVICE float saturated(float x) { return __saturatef(x); }  // into [0, 1]; a NaN is 0
DEVICE long long whole(long long bytes) {  // keeps the compiler from repeating the sum in every later address
    asm("" : "+l"(bytes));
    return bytes;
}
DEVICE int anew(int x) {  // keeps it from holding what depends on x in registers
    asm volatile("" : "+r"(x));
    return x;
}
DEVICE float as_float(unsigned bits) { return __uint_as_float(bits); }
DEVICE unsigned as_bits(float value) { return __float_as_uint(value); }
#endif

#define ROWS 4                // rows of a step of the streaming pass
#define RUN 8                 // rows of a thread of the pixelwise passes
#define REACH 5               // of SSIM's window
#define GROUPS (THREADS / 4)  // of four columns, in a row of a tile
#define PITCH (THREADS + 12)  // of a row that a horizontal blur reads: three zeros before it, some after it
#define INFINITE as_float(0x7f800000u)

// Eleven taps of a Gaussian of sigma 1.5, symmetric.
#define G0 0.001028380123898387f
#define G1 0.0075987582094967365f
#define G2 0.036000773310661316f
#define G3 0.10936068743467331f
#define G4 0.21300552785396576f
#define G5 0.26601171493530273f

// SSIM's constants.
#define K1 0.0001f
#define K2 0.0009f

struct Strides {  // strides in values
    long long view, channel;
    int row, column;
};

// What every kernel is given; kernels/cuda/backend.py packs the same. What is absent is a null pointer.
struct Task {
    const void* prediction;
    const void* target;
    float* gradient;       // unscaled, dense
    void* scaled;          // the gradient times *step, of the images' type
    const float* step;     // the gradient that arrives in backward
    float* partial;        // a block's sums
    float* result;         // the loss; of the range pass [views, 2]
    const float* map;      // [views or 1, height, width]
    const float* range;    // [views, 2]: the least response, the greatest less the least
    float* response;       // [views, height, width]: written by the range pass, read by the streaming pass
    Strides of_prediction, of_target, of_gradient;
    long long count;       // values (scale); blocks whose sums are to be added (finish)
    int views, channels, height, width;
    int strip;    // rows of a block of the streaming pass
    int curve;    // its number
    int chunks;   // blocks a view of the pixelwise passes
    int map_view;  // whether each view has a map of its own
    float side, middle;  // of a gradient's stencil: the outer and middle rows
    float beta, eps;
    float l1_step;    // the share of the weighted L1 in the loss, divided by the number of values
    float ssim_step;  // four times that of SSIM
    float constant;   // the rest of the loss
};

DEVICE float read(const float* at) { return *at; }
#if VALUE == 0
typedef float Value;
DEVICE void write(Value* at, float value) { *at = value; }
#else
typedef unsigned short Value;
#if VALUE == 1
DEVICE float read(const Value* at) { return half_to_float(*at); }
DEVICE void write(Value* at, float value) { *at = float_to_half(value); }
#else
DEVICE float read(const Value* at) { return as_float((unsigned)*at << 16); }
DEVICE void write(Value* at, float value) {  // to the nearest, ties to even
    unsigned bits = as_bits(value);
    bool number = (bits & 0x7fffffffu) <= 0x7f800000u;
    *at = (Value)(number ? (bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16 : (bits >> 16) | 0x40u);
}
#endif
#endif

DEVICE float reciprocal(float x) {  // to the last bit or its neighbour
    const float y = rough_reciprocal(x);
    return fmaf(y, fmaf(-x, y, 1.f), y);
}
DEVICE const Value* plane_of(const void* images, const Strides& of, long long view, long long channel) {
    return (const Value*)images + view * of.view + channel * of.channel;
}

// N rows of a column, from row `from` on, 0 outside the image; `at` goes on to the row after them.
template <class T, int N>
DEVICE void read_rows(const T*& at, int stride, int from, int height, float (&out)[N]) {
    if (from >= 0 && from + N <= height) {
#pragma unroll
        for (int r = 0; r < N; ++r, at += stride) out[r] = read(at);
    } else {
#pragma unroll
        for (int r = 0; r < N; ++r, at += stride) out[r] = from + r >= 0 && from + r < height ? read(at) : 0.f;
    }
}

// A slope and the derivative of weight * |d|, which is 0 where d is 0 (or no number).
DEVICE float with_l1(float slope, float weight, float d) {
    const float toward = as_float(as_bits(weight) ^ (as_bits(d) & 0x80000000u));
    return fabsf(d) > 0.f ? slope + toward : slope;
}

// ---- the weight of a pixel -----------------------------------------------------------------------------------------

#if STENCIL
DEVICE int reflected(int i, int size) { return size == 1 ? 0 : (i < 0 ? -i : (i >= size ? 2 * size - 2 - i : i)); }

DEVICE float joined(float sum, float value) {
#if NORM == 1
    return sum + fabsf(value);
#elif NORM == 2
    return fmaf(value, value, sum);
#else  // a NaN wins: the greater of two is one
    return fabsf(value) <= sum ? sum : fabsf(value) + 0.f * sum;
#endif
}

// The responses of RUN pixels of a column, from `row` on; `before` and `after` it are the columns beside it, in values.
// Differences are taken in an order that is exactly zero on a constant image.
DEVICE void responses(const Task& k, const Value* at, int row, int before, int after, float (&e)[RUN]) {
#pragma unroll
    for (int r = 0; r < RUN; ++r) e[r] = 0.f;
#pragma unroll 1
    for (int channel = 0; channel < k.channels; ++channel, at += k.of_target.channel) {
        auto line = [&](int r) {  // of rows that are not needed, one that is there
            const int wanted = row + r < k.height ? row + r : k.height;
            return at + reflected(wanted, k.height) * k.of_target.row;
        };
        const Value* here = line(0);
        float north = read(line(-1)), middle = read(here);
#if STENCIL != FOUR
        float north_west = read(line(-1) + before), north_east = read(line(-1) + after);
        float west = read(here + before), east = read(here + after);
#endif
#pragma unroll
        for (int r = 0; r < RUN; ++r) {
            const Value* below = line(r + 1);
            const float south = read(below);
#if STENCIL == FOUR
            e[r] = joined(e[r], fmaf(-4.f, middle, (north + south) + (read(here + before) + read(here + after))));
#else
            const float south_west = read(below + before), south_east = read(below + after);
#if STENCIL == EIGHT
            const float corners = (north_west + south_east) + (north_east + south_west);
            e[r] = joined(e[r], fmaf(-8.f, middle, ((north + south) + (west + east)) + corners));
#else
            float down = k.middle * (south - north), across = k.middle * (east - west);
            if (k.side != 0.f) {
                across = fmaf(k.side, (north_east - north_west) + (south_east - south_west), across);
                down = fmaf(k.side, (south_west - north_west) + (south_east - north_east), down);
            }
            e[r] = joined(joined(e[r], down), across);
#endif
            north_west = west; west = south_west; north_east = east; east = south_east;
#endif
            north = middle; middle = south; here = below;
        }
    }
#if NORM == 2
#pragma unroll
    for (int r = 0; r < RUN; ++r) e[r] = root(e[r]);
#endif
}

DEVICE void responses(const Task& k, const Value* target, int row, int column, float (&e)[RUN]) {
    const int stride = k.of_target.column;
    const int before = (reflected(column - 1, k.width) - column) * stride;
    const int after = (reflected(column + 1, k.width) - column) * stride;
    if (before == -1 && after == 1) responses(k, target + column, row, -1, 1, e);  // neighbours by constant offsets
    else responses(k, target + column * stride, row, before, after, e);
}
#endif

// What the weights of one view share.
struct Weights {
    int rows;  // of the views before it
    float low, scale;
};

DEVICE Weights weights_of(const Task& k, int view) {
    Weights w;
    w.rows = view * k.height;
    w.low = w.scale = 0.f;
    if (k.range) {
        const float span = k.range[2 * view + 1];
        w.low = k.range[2 * view];
        w.scale = span == 0.f ? 0.f : 1.f / (span + k.eps);  // a NaN is not equal to 0
    }
    return w;
}

// Of an angle of at most 30 degrees.
DEVICE float short_sine(float angle) {
    const float square = angle * angle;
    const float high = fmaf(square, fmaf(square, 1.f / 362880.f, -1.f / 5040.f), 1.f / 120.f);
    return angle * fmaf(square, fmaf(square, high, -1.f / 6.f), 1.f);
}

// Turns responses into weights.
template <int N>
DEVICE void weigh(const Task& k, const Weights& w, float (&values)[N]) {
#pragma unroll
    for (int r = 0; r < N; ++r) values[r] = saturated((values[r] - w.low) * w.scale);
#define CURVE(number, formula)                                \
    else if (k.curve == number) {                             \
        _Pragma("unroll")                                     \
        for (int r = 0; r < N; ++r) {                         \
            const float x = values[r];                        \
            values[r] = formula;                              \
        }                                                     \
    }
    if (false) {}
    CURVES
#undef CURVE
    const float one = fmaf(0.f, w.scale, 1.f);  // not a number where the range is none: then no weight is one
#pragma unroll
    for (int r = 0; r < N; ++r) values[r] = fmaf(k.beta, values[r], one);
}

// The weights of N pixels of a column, from a row on, 0 outside the image. Responses are in `x` already, or in memory.
template <int N>
DEVICE void weights_at(const Task& k, const Weights& w, int row, int column, bool responded, float (&x)[N]) {
    auto read_map = [&](const float* map, int above, float (&out)[N]) {
        const float* at = map + ((long long)anew(above + row) * k.width + column);
        read_rows(at, k.width, row, k.height, out);
    };
    if (!responded && k.response) {
        read_map(k.response, w.rows, x);
        responded = true;
    }
    if (responded) {
        weigh(k, w, x);
    } else {
#pragma unroll
        for (int r = 0; r < N; ++r) x[r] = 1.f;
    }
    if (k.map) {
        float factor[N];
        read_map(k.map, k.map_view ? w.rows : 0, factor);
#pragma unroll
        for (int r = 0; r < N; ++r) x[r] *= factor[r];
    }
}

// ---- sums ----------------------------------------------------------------------------------------------------------

// Adds a value of each thread in an order that never changes, and hands the sum to the first.
template <class Lane, class Lanes, class Number, class Write>
DEVICE void add_up(Lanes& lanes, Number (&scratch)[THREADS], Write write_result) {
    for (int n = THREADS / 2; n > 0; n >>= 1)
        phase(lanes, [&](Lane&, int t) { if (t < n) scratch[t] += scratch[t + n]; });
    phase(lanes, [&](Lane&, int t) { if (t == 0) write_result(scratch[0]); });
}

#if STENCIL == 0
struct Sum { double of_blocks; };

// One block: the loss from all blocks' sums.
KERNEL(legs_finish, 1) {
    SHARED double scratch[THREADS];
    LANES(Sum, lanes);
    phase(lanes, [&](Sum& lane, int t) {
        lane.of_blocks = 0.;
        for (long long i = t; i < k.count; i += THREADS) lane.of_blocks += k.partial[i];
        scratch[t] = lane.of_blocks;
    });
    add_up<Sum>(lanes, scratch, [&](double sum) { k.result[0] = (float)(sum + k.constant); });
}

struct Nothing {};

// The gradient times the step that arrives in backward, read here, rounded once to the images' type.
KERNEL(legs_scale, 1) {
    LANES(Nothing, lanes);
    phase(lanes, [&](Nothing&, int t) {
        const float step = *k.step;
        if (step == 1.f && k.scaled == (void*)k.gradient) return;
        for (long long i = BLOCK * THREADS + t; i < k.count; i += BLOCKS * THREADS)
            write((Value*)k.scaled + i, step * k.gradient[i]);
    });
}
#endif

// ---- the pixelwise passes: a thread has RUN rows of a column -------------------------------------------------------

struct Run { long long view; int row, column, rows; };

DEVICE Run run_of(const Task& k, int t) {
    const int tiles = (k.width + THREADS - 1) / THREADS, chunk = (int)(BLOCK % k.chunks);
    Run run;
    run.view = BLOCK / k.chunks;
    run.row = chunk / tiles * RUN;
    run.column = chunk % tiles * THREADS + t;
    run.rows = run.column >= k.width ? 0 : (run.row + RUN < k.height ? RUN : k.height - run.row);
    return run;
}

#if STENCIL
struct Extremes { float low, high, poison; };

DEVICE void join(Extremes& a, float low, float high, float poison) {
    a.low = fminf(low, a.low);
    a.high = fmaxf(high, a.high);
    a.poison += poison;
}

template <class Lanes, class Body>
DEVICE void over_threads(Lanes& lanes, float* scratch, Body write_result) {
    phase(lanes, [&](Extremes& lane, int t) {
        scratch[t] = lane.low; scratch[THREADS + t] = lane.high; scratch[2 * THREADS + t] = lane.poison;
    });
    for (int n = THREADS / 2; n > 0; n >>= 1)
        phase(lanes, [&](Extremes& lane, int t) {
            if (t < n) {
                join(lane, scratch[t + n], scratch[THREADS + t + n], scratch[2 * THREADS + t + n]);
                scratch[t] = lane.low; scratch[THREADS + t] = lane.high; scratch[2 * THREADS + t] = lane.poison;
            }
        });
    phase(lanes, [&](Extremes& lane, int t) { if (t == 0) write_result(lane); });
}

// The range of a view's response, and where it is wanted the response.
KERNEL(legs_range, 1) {
    SHARED float scratch[3 * THREADS];
    LANES(Extremes, lanes);
    phase(lanes, [&](Extremes& lane, int t) {
        lane.low = INFINITE; lane.high = 0.f; lane.poison = 0.f;
        const Run run = run_of(k, t);
        if (!run.rows) return;
        float e[RUN];
        responses(k, plane_of(k.target, k.of_target, run.view, 0), run.row, run.column, e);
        float* to = k.response + (k.response ? (run.view * k.height + run.row) * k.width + run.column : 0);
#pragma unroll
        for (int r = 0; r < RUN; ++r) {
            if (r >= run.rows) break;
            if (k.response) to[r * k.width] = e[r];
            join(lane, e[r], e[r], 0.f * e[r]);
        }
    });
    over_threads(lanes, scratch, [&](const Extremes& all) {
        k.partial[BLOCK] = all.low; k.partial[BLOCKS + BLOCK] = all.high; k.partial[2 * BLOCKS + BLOCK] = all.poison;
    });
}

// A block a view.
KERNEL(legs_range_finish, 1) {
    SHARED float scratch[3 * THREADS];
    LANES(Extremes, lanes);
    phase(lanes, [&](Extremes& lane, int t) {
        lane.low = INFINITE; lane.high = 0.f; lane.poison = 0.f;
        const float* found = k.partial + BLOCK * k.chunks;
        for (int i = t; i < k.chunks; i += THREADS) join(lane, found[i], found[k.count + i], found[2 * k.count + i]);
    });
    over_threads(lanes, scratch, [&](const Extremes& all) {
        k.result[2 * BLOCK] = all.low + all.poison;
        k.result[2 * BLOCK + 1] = (all.high - all.low) + all.poison;
    });
}
#endif

struct One { float loss; };

// The weighted L1 alone.
template <bool WANTED>
DEVICE void l1(const Task& k) {
    SHARED float scratch[THREADS];
    LANES(One, lanes);
    phase(lanes, [&](One& lane, int t) {
        lane.loss = 0.f;
        const Run run = run_of(k, t);
        if (!run.rows) return;
        const Weights weights = weights_of(k, (int)run.view);
        float w[RUN];
#if STENCIL
        responses(k, plane_of(k.target, k.of_target, run.view, 0), run.row, run.column, w);
#endif
        weights_at(k, weights, run.row, run.column, STENCIL != 0, w);
#pragma unroll 1
        for (int channel = 0; channel < k.channels; ++channel) {
            const Value* x = plane_of(k.prediction, k.of_prediction, run.view, channel)
                             + run.row * k.of_prediction.row + run.column * k.of_prediction.column;
            const Value* y = plane_of(k.target, k.of_target, run.view, channel)
                             + run.row * k.of_target.row + run.column * k.of_target.column;
            float* to = k.gradient + (WANTED ? run.view * k.of_gradient.view + channel * k.of_gradient.channel
                                               + run.row * k.of_gradient.row + run.column * k.of_gradient.column : 0);
#pragma unroll
            for (int r = 0; r < RUN; ++r) {
                if (r >= run.rows) break;
                const float d = read(x + r * k.of_prediction.row) - read(y + r * k.of_target.row);
                const float weight = k.l1_step * w[r];
                lane.loss = fmaf(weight, fabsf(d), lane.loss);
                if (WANTED) to[r * k.of_gradient.row] = with_l1(0.f, weight, d);
            }
        }
    });
    phase(lanes, [&](One& lane, int t) { scratch[t] = lane.loss; });
    add_up<One>(lanes, scratch, [&](float sum) { k.partial[BLOCK] = sum; });
}

KERNEL(legs_l1_gradient, 1) { l1<true>(k); }
KERNEL(legs_l1_value, 1) { l1<false>(k); }

// ---- SSIM, with or without the weighted L1 -------------------------------------------------------------------------

#if STENCIL == 0
struct __align__(16) Quad { float a, b, c, d; };

// A vertical blur, times SCALE, as a transposed FIR: the shift is in the destination of the multiply-add. Returns the
// blurred value of five rows ago.
template <int SCALE>
DEVICE float push(float (&s)[10], float x) {
    const float z = SCALE;
    const float out = fmaf(z * G0, x, s[0]);
    s[0] = fmaf(z * G1, x, s[1]); s[1] = fmaf(z * G2, x, s[2]); s[2] = fmaf(z * G3, x, s[3]);
    s[3] = fmaf(z * G4, x, s[4]); s[4] = fmaf(z * G5, x, s[5]); s[5] = fmaf(z * G4, x, s[6]);
    s[6] = fmaf(z * G3, x, s[7]); s[7] = fmaf(z * G2, x, s[8]); s[8] = fmaf(z * G1, x, s[9]);
    s[9] = z * G0 * x;
    return out;
}

// A horizontal blur, plus a constant: four neighbouring values from 14 of 16. Four are read at a time, which takes few
// registers, the outer ones first: small terms are added up before large ones.
DEVICE void across(const float* from, float plus, float (&out)[4]) {
    const float taps[11] = {G0, G1, G2, G3, G4, G5, G4, G3, G2, G1, G0};
#pragma unroll
    for (int j = 0; j < 4; ++j) out[j] = plus;
#pragma unroll
    for (int m = 0; m < 4; ++m) {
        const int first = 4 * (m % 2 ? 3 - m / 2 : m / 2);
        const Quad q = *reinterpret_cast<const Quad*>(from + first);
        const float v[4] = {q.a, q.b, q.c, q.d};
#pragma unroll
        for (int i = first; i < first + 4; ++i)
#pragma unroll
            for (int j = 0; j < 4; ++j)
                if (i >= j && i - j < 11) out[j] = fmaf(taps[i - j], v[i - first], out[j]);
    }
}

DEVICE void put(float* to, const float (&v)[4]) { *reinterpret_cast<Quad*>(to) = Quad{v[0], v[1], v[2], v[3]}; }

struct Stream {
    float moments[4][10], slopes[3][10];  // rows on their way through the vertical blurs
    float u[ROWS], v[ROWS];               // the next rows
    int x, y;                             // where in their planes the rows after them are
    float* column;                        // in shared memory: of the vertical blurs
    float* group;                         // of the horizontal ones
    float loss;
};

// Shared memory has a row of each of these, ROWS times: moments (column c at c + 3), slopes (at c - 2), blurred slopes (at c - 7).
#define MOMENT(j) ((j) * ROWS * PITCH)
#define SLOPE(j) ((4 + (j)) * ROWS * PITCH)
#define BLURRED(j) ((7 + (j)) * ROWS * PITCH)

// A block has a strip of a tile, some rows a step. A thread has a column in the vertical blurs, and four columns of one row
// in the horizontal ones: rows go through moments (vertical, horizontal), SSIM and its slopes, slopes (horizontal,
// vertical), so that only what a horizontal blur reads, and what it returns, goes through shared memory.
template <bool L1, bool WANTED>
DEVICE void stream(const Task& k) {
    const int halo = WANTED ? 2 * REACH : REACH + 1, core = THREADS - 2 * halo;
    SHARED float memory[(WANTED ? 10 : 4) * ROWS * PITCH];
    LANES(Stream, lanes);

    // The channels of a tile are neighbours in time, so that what they share is in the cache.
    const int tiles = (k.width + core - 1) / core, strips = (k.height + k.strip - 1) / k.strip;
    unsigned rest = (unsigned)BLOCK;
    const int channel = rest % (unsigned)k.channels; rest /= (unsigned)k.channels;
    const int left = (int)(rest % (unsigned)tiles) * core - halo; rest /= (unsigned)tiles;
    const int first = (int)(rest % (unsigned)strips) * k.strip;
    const long long view = rest / (unsigned)strips;
    const int last = first + k.strip < k.height ? first + k.strip : k.height;
    // The rows that go in; from the step of `needed` on SSIM is computed.
    const int start = first - (WANTED ? 2 * REACH : 2 * ROWS), end = last + (WANTED ? 2 * REACH : REACH);
    const int needed = first + (WANTED ? 0 : REACH);
    auto plane = [&](const void* images, const Strides& of, int size) {
        return (const char*)images + whole((view * of.view + channel * of.channel) * size);
    };
    const Value* xs = (const Value*)plane(k.prediction, k.of_prediction, sizeof(Value));
    const Value* ys = (const Value*)plane(k.target, k.of_target, sizeof(Value));
    float* gradient = WANTED ? (float*)plane(k.gradient, k.of_gradient, sizeof(float)) : 0;
    const Weights weights = weights_of(k, (int)view);

    auto inside = [&](int t) { return left + t >= 0 && left + t < k.width; };
    auto owned = [&](int t) { return t >= halo && t < halo + core && left + t < k.width; };
    auto group_of = [&](Stream& lane, int t) {  // with the weights in its registers a thread has none left for it
        return L1 && WANTED ? memory + t / GROUPS * PITCH + t % GROUPS * 4 : lane.group;
    };
    auto fetch = [&](Stream& lane, int t, int row) {
        if (!inside(t)) return;
        const Value *x = xs + lane.x, *y = ys + lane.y;
        read_rows(x, k.of_prediction.row, row, k.height, lane.u);
        read_rows(y, k.of_target.row, row, k.height, lane.v);
        lane.x += ROWS * k.of_prediction.row;
        lane.y += ROWS * k.of_target.row;
    };
    auto push_moments = [&](Stream& lane, int t, int row) {
        if (!inside(t)) return;
        float* to = lane.column + 3;
#pragma unroll
        for (int r = 0; r < ROWS; ++r, to += PITCH) {
            const float u = lane.u[r], v = lane.v[r];
            to[MOMENT(0)] = push<1>(lane.moments[0], u);
            to[MOMENT(1)] = push<1>(lane.moments[1], v);
            to[MOMENT(2)] = push<1>(lane.moments[2], fmaf(u, u, v * v));
            to[MOMENT(3)] = push<1>(lane.moments[3], u * v);
        }
        if (L1 && !WANTED && row >= first && owned(t)) {
#pragma unroll 1  // it keeps the weight's registers out of the blur's way
            for (int r = row; r < row + ROWS && r < last; ++r) {
                float w[1];
                weights_at(k, weights, r, left + t, false, w);
                const float d = read(xs + (r * k.of_prediction.row + (left + t) * k.of_prediction.column))
                                - read(ys + (r * k.of_target.row + (left + t) * k.of_target.column));
                lane.loss = fmaf(k.l1_step * w[0], fabsf(d), lane.loss);
            }
        }
    };
    auto push_slopes = [&](Stream& lane, int t, int row) {  // row: the first whose gradient is complete then
        if (!owned(t)) return;
        float u[ROWS], v[ROWS], w[ROWS], slope[ROWS];
        const Value* x = xs + (lane.x - (2 * ROWS + 2 * REACH) * k.of_prediction.row);
        const Value* y = ys + (lane.y - (2 * ROWS + 2 * REACH) * k.of_target.row);
        read_rows(x, k.of_prediction.row, row, k.height, u);
        read_rows(y, k.of_target.row, row, k.height, v);
        if (L1) weights_at(k, weights, row, left + t, false, w);
        const float* from = lane.column - 7;
#pragma unroll
        for (int r = 0; r < ROWS; ++r, from += PITCH) {
            slope[r] = push<1>(lane.slopes[0], from[BLURRED(0)]);
            slope[r] = fmaf(u[r], push<-2>(lane.slopes[1], from[BLURRED(1)]), slope[r]);
            slope[r] = fmaf(v[r], push<1>(lane.slopes[2], from[BLURRED(2)]), slope[r]);
        }
        float* to = gradient + (row * k.of_gradient.row + (left + t) * k.of_gradient.column);
        auto finish = [&](int rows) {
#pragma unroll
            for (int r = 0; r < ROWS; ++r) {
                if (r >= rows) break;
                if (L1) {
                    const float d = u[r] - v[r];
                    w[r] *= k.l1_step;
                    lane.loss = fmaf(w[r], fabsf(d), lane.loss);
                    slope[r] = with_l1(slope[r], w[r], d);
                }
                *to = slope[r];
                to += k.of_gradient.row;
            }
        };
        if (row >= first && row + ROWS <= last) finish(ROWS);
        else if (row >= first) finish(last - row);
    };

    phase(lanes, [&](Stream& lane, int t) {
#pragma unroll
        for (int j = 0; j < 10; ++j) {
            lane.moments[0][j] = lane.moments[1][j] = lane.moments[2][j] = lane.moments[3][j] = 0.f;
            lane.slopes[0][j] = lane.slopes[1][j] = lane.slopes[2][j] = 0.f;
        }
        lane.loss = 0.f;
        const int column = left + t;
        lane.x = start * k.of_prediction.row + column * k.of_prediction.column;
        lane.y = start * k.of_target.row + column * k.of_target.column;
        lane.column = memory + t;
        lane.group = memory + t / GROUPS * PITCH + t % GROUPS * 4;
        // What lies outside the image is never written, and stays zero.
        const float zeros[4] = {};
        for (int j = 4 * t; j < (WANTED ? 7 : 4) * ROWS * PITCH; j += 4 * THREADS) put(memory + j, zeros);
        fetch(lane, t, start);
    });
    // Of the rows from `base` on moments go in; SSIM of those of REACH rows before comes out, and the gradient of 2 * REACH.
    for (int base = start;; base += ROWS) {
        const bool light = base + ROWS <= needed;
        phase(lanes, [&](Stream& lane, int t) {
            t = anew(t);
            if (WANTED && base > first) push_slopes(lane, t, base - ROWS - 2 * REACH);
            if (base < end) push_moments(lane, t, base);
            if (light) fetch(lane, t, base + ROWS);
        });
        if (base >= end) break;
        if (light) continue;
        phase(lanes, [&](Stream& lane, int t) {
            t = anew(t);
            float* group = group_of(lane, t);
            if (!WANTED) fetch(lane, t, base + ROWS);
            const int row = base + t / GROUPS - REACH, at = t % GROUPS * 4, column = left + 2 + at;
            if (column + 3 < 0 || column >= k.width) return;
            float m1[4] = {}, m2[4] = {}, squares[4], product[4] = {};
            if (row >= 0 && row < k.height) {
                across(group + MOMENT(0), 0.f, m1);
                across(group + MOMENT(1), 0.f, m2);
                across(group + MOMENT(2), K1 + K2, squares);
                across(group + MOMENT(3), 0.5f * (K1 + K2), product);
#pragma unroll
                for (int j = 0; j < 4; ++j) {
                    // SSIM is (2 a1 * 2 a2) / (d1 * d2); with the scale all is the gradient's own.
                    const float d1 = fmaf(m1[j], m1[j], fmaf(m2[j], m2[j], K1)), d2 = squares[j] - d1;
                    const float a1 = fmaf(m1[j], m2[j], 0.5f * K1), a2 = product[j] - a1;
                    const float inverse = reciprocal(d1 * d2), scaled = k.ssim_step * inverse;
                    const float third = a1 * scaled, similarity = a2 * third;
                    const float part = similarity * inverse, second = d1 * part;
                    const float toward = fmaf(a2, scaled, -third), away = fmaf(-part, d2, second);
                    m1[j] = fmaf(m1[j], away, fmaf(m1[j], away, m2[j] * toward));
                    m2[j] = second;
                    product[j] = third;
                    squares[j] = similarity;
                }
                if (column < 0 || column + 3 >= k.width) {
#pragma unroll
                    for (int j = 0; j < 4; ++j)
                        if (column + j < 0 || column + j >= k.width) m1[j] = m2[j] = product[j] = squares[j] = 0.f;
                }
                if (row >= first && row < last && at + 2 >= halo && at + 2 < halo + core)
                    lane.loss += (squares[0] + squares[1]) + (squares[2] + squares[3]);
            }
            if (WANTED) {
                put(group + SLOPE(0), m1);
                put(group + SLOPE(1), m2);
                put(group + SLOPE(2), product);
            }
        });
        if (!WANTED) continue;
        phase(lanes, [&](Stream& lane, int t) {
            t = anew(t);
            float* group = group_of(lane, t);
            fetch(lane, t, base + ROWS);  // on its way meanwhile
            const int at = t % GROUPS * 4, column = left + 7 + at;
            if (column + 3 < 0 || column >= k.width || at + 16 > THREADS) return;
#pragma unroll
            for (int j = 0; j < 3; ++j) {
                float out[4];
                across(group + SLOPE(j), 0.f, out);
                put(group + BLURRED(j), out);
            }
        });
    }
    SHARED float scratch[THREADS];
    phase(lanes, [&](Stream& lane, int t) { scratch[t] = lane.loss; });
    add_up<Stream>(lanes, scratch, [&](float sum) { k.partial[BLOCK] = sum; });
}

KERNEL(legs_loss_gradient, 2) { stream<true, true>(k); }
KERNEL(legs_loss_value, 2) { stream<true, false>(k); }
KERNEL(legs_ssim_gradient, 2) { stream<false, true>(k); }
KERNEL(legs_ssim_value, 2) { stream<false, false>(k); }
#endif
