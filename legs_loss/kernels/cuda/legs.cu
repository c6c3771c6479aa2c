// The weighted L1 and SSIM, value and gradient, in one pass. For NVRTC: no includes, C++14.
//
// Compiled with -DVALUE=0|1|2 (images of float32, float16, bfloat16), -DSTENCIL=0|1|2|3 (weights from a map or none;
// from the target's response to the 4-neighbour Laplacian, the 8-neighbour one, a gradient) and -DNORM=1|2|3 (the norm
// over channels: 1, 2, infinity). a * b + c is rounded twice unless fmaf says otherwise (--fmad=false), so that every
// compiler gives the same bits.
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
#define THREADS 128
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
DEVICE float reciprocal(float x) {  // to the last bit or its neighbour; no path for subnormal numbers
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return fmaf(y, fmaf(-x, y, 1.f), y);
}
DEVICE float as_float(unsigned bits) { return __uint_as_float(bits); }
DEVICE unsigned as_bits(float value) { return __float_as_uint(value); }
#endif

#define ROWS 4             // rows a step of the streaming pass
// Rows that the vertical blurs of a step unroll: of the moments, of the slopes. More of them spill a few bytes.
#if defined(__CUDACC_VER_MAJOR__) && __CUDACC_VER_MAJOR__ < 12
#define MOMENT_ROWS 2
#define SLOPE_ROWS 1
#else
#define MOMENT_ROWS ROWS
#define SLOPE_ROWS 2
#endif
#define REACH 5            // of SSIM's window
#define PITCH (THREADS + 16)  // a row with its margins: 5 zeros before it, 11 after it
#define INFINITE as_float(0x7f800000u)

// Eleven taps of a Gaussian of sigma 1.5, symmetric.
#define G0 0.001028380123898387f
#define G1 0.0075987582094967365f
#define G2 0.036000773310661316f
#define G3 0.10936068743467331f
#define G4 0.21300552785396576f
#define G5 0.26601171493530273f

struct Layout {  // strides in values
    long long view, channel;
    int row, column;
};

// What every kernel is given; kernels/cuda/launch.py packs the same. What is absent is a null pointer.
struct Task {
    const void* prediction;
    const void* target;
    float* gradient;       // unscaled, dense
    void* scaled;          // the gradient times *step, of the images' type
    const float* step;     // the gradient that arrives in backward
    float* partial;        // a block's sums
    float* result;         // the loss; of the range pass [views, 2]
    const float* map;      // [views or 1, height, width]
    const float* mask;     // the same
    const float* covered;  // the mask's mean, where the L1 is divided by it
    const float* range;    // [views, 2]: the least response, the greatest less the least
    float* response;       // [views, height, width], of the range pass; in its place the weights of the streaming pass
    Layout of_prediction, of_target, of_gradient;
    long long map_view, mask_view;  // strides between views, 0 for one map for all
    long long count;                // values (scale); blocks whose sums are to be added (finish)
    int views, channels, height, width;
    int strip;    // rows of a block of the streaming pass
    int curve;    // 1 to 5
    int chunks;   // blocks a view of the pixelwise passes
    float side, middle;  // of a gradient's stencil: the outer and middle rows
    float beta, eps;
    float l1_share, ssim_share, constant;  // the loss is l1_share * L1 + ssim_share * SSIM + constant
};

#if VALUE == 0
typedef float Value;
DEVICE float read(const Value* at) { return *at; }
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

DEVICE float greater(float a, float b) { return a > b ? a : b; }
DEVICE float sign(float d) { return d > 0.f ? 1.f : (d < 0.f ? -1.f : 0.f); }
DEVICE const Value* plane_of(const void* images, const Layout& of, long long view, long long channel) {
    return (const Value*)images + view * of.view + channel * of.channel;
}

// ---- the weight of a pixel -----------------------------------------------------------------------------------------

#if STENCIL
DEVICE int reflected(int i, int size) { return size == 1 ? 0 : (i < 0 ? -i : (i >= size ? 2 * size - 2 - i : i)); }

DEVICE float joined(float sum, float value) {
#if NORM == 1
    return sum + fabsf(value);
#elif NORM == 2
    return fmaf(value, value, sum);
#else
    return greater(fabsf(value), sum);
#endif
}

// The response of a pixel. Differences are taken in an order that is exactly zero on a constant image. With the norm
// "infinity" a NaN would lose every comparison, so it is carried along in `poison`.
DEVICE float response(const Task& k, const Value* view, int row, int column) {
    const int up = reflected(row - 1, k.height) * k.of_target.row, down = reflected(row + 1, k.height) * k.of_target.row;
    const int left = reflected(column - 1, k.width) * k.of_target.column;
    const int right = reflected(column + 1, k.width) * k.of_target.column;
    const int here = row * k.of_target.row, middle = column * k.of_target.column;
    float strength = 0.f, poison = 0.f;
#pragma unroll 1
    for (int channel = 0; channel < k.channels; ++channel, view += k.of_target.channel) {
        const float north = read(view + up + middle), south = read(view + down + middle);
        const float west = read(view + here + left), east = read(view + here + right);
        float value;
#if STENCIL == 1
        value = fmaf(-4.f, read(view + here + middle), (north + south) + (west + east));
#elif STENCIL == 2
        value = (read(view + up + left) + read(view + down + right)) + (read(view + up + right) + read(view + down + left));
        value = fmaf(-8.f, read(view + here + middle), ((north + south) + (west + east)) + value);
#else
        float other = k.middle * (south - north);
        value = k.middle * (east - west);
        if (k.side != 0.f) {
            const float first = read(view + up + left), second = read(view + up + right);
            const float third = read(view + down + left), fourth = read(view + down + right);
            value = fmaf(k.side, (second - first) + (fourth - third), value);
            other = fmaf(k.side, (third - first) + (fourth - second), other);
        }
        strength = joined(strength, other);
        poison += 0.f * other;
#endif
        strength = joined(strength, value);
        poison += 0.f * value;
    }
#if NORM == 2
    strength = sqrtf(strength);
#endif
    return strength + poison;
}
#endif

DEVICE float curve(int which, float x) {
    if (which == 1) return x;
    if (which == 2) return x * x;
    if (which == 3) return sqrtf(x);
    if (which == 4) return x * x * fmaf(-2.f, x, 3.f);
    // 1/2 - sin(asin(1 - 2x) / 3); the sine of an angle of at most 30 degrees is a short polynomial.
    const float angle = asinf(fmaf(-2.f, x, 1.f)) * (1.f / 3.f), square = angle * angle;
    const float sine = angle * fmaf(square, fmaf(square, fmaf(square, fmaf(square, 1.f / 362880.f, -1.f / 5040.f),
                                                               1.f / 120.f), -1.f / 6.f), 1.f);
    const float y = 0.5f - sine;
    return y < 0.f ? 0.f : (y > 1.f ? 1.f : y);
}

// What the weights of one view share.
struct Weights {
    const float* map;
    const float* mask;
    const Value* target;
    const float* response;
    float low, scale;
};

DEVICE Weights weights_of(const Task& k, long long view) {
    Weights w;
    w.map = k.map ? k.map + view * k.map_view : 0;
    w.mask = k.mask ? k.mask + view * k.mask_view : 0;
    w.target = plane_of(k.target, k.of_target, view, 0);
    w.response = k.response ? k.response + view * k.height * k.width : 0;
    w.low = w.scale = 0.f;
    if (k.range) {
        const float span = k.range[2 * view + 1];
        w.low = k.range[2 * view];
        w.scale = span == 0.f ? 0.f : 1.f / (span + k.eps);  // a NaN is not equal to 0
    }
    return w;
}

DEVICE float weight_of(const Task& k, const Weights& w, float response) {
    float x = (response - w.low) * w.scale;
    x = x < 0.f ? 0.f : (x > 1.f ? 1.f : x);  // rounding; a NaN stays
    return fmaf(k.beta, curve(k.curve, x), 1.f);
}

// The weight of a pixel of the pixelwise passes; `at` is row * width + column.
DEVICE float weight_at(const Task& k, const Weights& w, int row, int column, int at) {
#if STENCIL
    float weight = weight_of(k, w, response(k, w.target, row, column));
#else
    float weight = w.response ? weight_of(k, w, w.response[at]) : 1.f;
#endif
    if (w.map) weight *= w.map[at];
    return w.mask ? weight * w.mask[at] : weight;
}

DEVICE float l1_step(const Task& k, float values) {
    const float least = 1.1754944e-38f;
    return k.l1_share / values / (k.covered ? greater(*k.covered, least) : 1.f);
}

// ---- sums ----------------------------------------------------------------------------------------------------------

// Adds two values of each thread in an order that never changes and writes the block's sums.
template <class Lane, class Lanes, class First, class Second>
DEVICE void write_sums(const Task& k, Lanes& lanes, float* scratch, First first, Second second) {
    phase(lanes, [&](Lane& lane, int t) { scratch[t] = first(lane); scratch[THREADS + t] = second(lane); });
    for (int n = THREADS / 2; n > 0; n >>= 1)
        phase(lanes, [&](Lane&, int t) {
            if (t < n) { scratch[t] += scratch[t + n]; scratch[THREADS + t] += scratch[THREADS + t + n]; }
        });
    phase(lanes, [&](Lane&, int t) {
        if (t == 0) { k.partial[BLOCK] = scratch[0]; k.partial[BLOCKS + BLOCK] = scratch[THREADS]; }
    });
}

#if STENCIL == 0
struct Sums { double l1, ssim; };

// One block: the loss from all blocks' sums.
KERNEL(legs_finish, 1) {
    SHARED double l1[THREADS];
    SHARED double ssim[THREADS];
    LANES(Sums, lanes);
    phase(lanes, [&](Sums& lane, int t) {
        lane.l1 = lane.ssim = 0.;
        for (long long i = t; i < k.count; i += THREADS) { lane.l1 += k.partial[i]; lane.ssim += k.partial[k.count + i]; }
        l1[t] = lane.l1;
        ssim[t] = lane.ssim;
    });
    for (int n = THREADS / 2; n > 0; n >>= 1)
        phase(lanes, [&](Sums&, int t) { if (t < n) { l1[t] += l1[t + n]; ssim[t] += ssim[t + n]; } });
    phase(lanes, [&](Sums&, int t) {
        if (t == 0) {
            const double values = (double)k.views * k.channels * k.height * k.width;
            const double covered = k.covered ? greater(*k.covered, 1.1754944e-38f) : 1.f;
            k.result[0] = (float)(k.l1_share * (l1[0] / values / covered) + k.ssim_share * (ssim[0] / values) + k.constant);
        }
    });
}

struct Nothing {};

// The weight of each pixel, once for all channels, for the streaming pass: there each channel has a block of its own. The
// response is overwritten, where there is one.
KERNEL(legs_weights, 1) {
    LANES(Nothing, lanes);
    const int view = (int)(BLOCK / k.chunks), chunk = (int)(BLOCK % k.chunks), pixels = k.height * k.width;
    phase(lanes, [&](Nothing&, int t) {
        const Weights weights = weights_of(k, view);
        for (long long p = (long long)chunk * THREADS + t; p < pixels; p += (long long)k.chunks * THREADS)
            k.result[(long long)view * pixels + p] = weight_at(k, weights, 0, 0, (int)p);
    });
}

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

// ---- the range of a view's response --------------------------------------------------------------------------------

#if STENCIL
struct Extremes { float low, high, poison; };

DEVICE void join(Extremes& a, float low, float high, float poison) {
    a.low = low < a.low ? low : a.low;
    a.high = greater(high, a.high);
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

KERNEL(legs_range, 1) {
    SHARED float scratch[3 * THREADS];
    LANES(Extremes, lanes);
    const int view = (int)(BLOCK / k.chunks), chunk = (int)(BLOCK % k.chunks), pixels = k.height * k.width;
    phase(lanes, [&](Extremes& lane, int t) {
        lane.low = INFINITE; lane.high = 0.f; lane.poison = 0.f;
        const Value* target = plane_of(k.target, k.of_target, view, 0);
        for (long long p = (long long)chunk * THREADS + t; p < pixels; p += (long long)k.chunks * THREADS) {
            const int row = (int)p / k.width;
            const float e = response(k, target, row, (int)p - row * k.width);
            if (k.response) k.response[(long long)view * pixels + p] = e;
            join(lane, e, e, 0.f * e);
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

// ---- the weighted L1 alone -----------------------------------------------------------------------------------------

struct One { float absolute; };

template <bool WANTED>
DEVICE void l1(const Task& k) {
    SHARED float scratch[2 * THREADS];
    LANES(One, lanes);
    const int view = (int)(BLOCK / k.chunks), chunk = (int)(BLOCK % k.chunks), pixels = k.height * k.width;
    phase(lanes, [&](One& lane, int t) {
        lane.absolute = 0.f;
        const Weights weights = weights_of(k, view);
        const float step = l1_step(k, (float)k.views * k.channels * k.height * k.width);
        for (long long p = (long long)chunk * THREADS + t; p < pixels; p += (long long)k.chunks * THREADS) {
            const int row = (int)p / k.width, column = (int)p - row * k.width;
            const float w = weight_at(k, weights, row, column, (int)p);
            for (int channel = 0; channel < k.channels; ++channel) {
                const float u = read(plane_of(k.prediction, k.of_prediction, view, channel)
                                     + row * k.of_prediction.row + column * k.of_prediction.column);
                const float v = read(plane_of(k.target, k.of_target, view, channel)
                                     + row * k.of_target.row + column * k.of_target.column);
                const float d = u - v;
                lane.absolute = fmaf(w, fabsf(d), lane.absolute);
                if (WANTED)
                    k.gradient[view * k.of_gradient.view + channel * k.of_gradient.channel
                               + row * k.of_gradient.row + column * k.of_gradient.column] = step * w * sign(d);
            }
        }
    });
    write_sums<One>(k, lanes, scratch, [](const One& lane) { return lane.absolute; }, [](const One&) { return 0.f; });
}

KERNEL(legs_l1_gradient, 1) { l1<true>(k); }
KERNEL(legs_l1_value, 1) { l1<false>(k); }

// ---- SSIM, with or without the weighted L1 -------------------------------------------------------------------------

struct __align__(16) Quad { float a, b, c, d; };

// A transposed FIR: the shift is in the destination of the multiply-add. Returns the blurred value of five rows ago.
DEVICE float push(float (&s)[10], float x) {
    const float out = fmaf(G0, x, s[0]);
    s[0] = fmaf(G1, x, s[1]); s[1] = fmaf(G2, x, s[2]); s[2] = fmaf(G3, x, s[3]); s[3] = fmaf(G4, x, s[4]);
    s[4] = fmaf(G5, x, s[5]); s[5] = fmaf(G4, x, s[6]); s[6] = fmaf(G3, x, s[7]); s[7] = fmaf(G2, x, s[8]);
    s[8] = fmaf(G1, x, s[9]); s[9] = G0 * x;
    return out;
}

// Four neighbouring values of a blurred row from 14 of 16 inputs.
DEVICE Quad across(const float (&v)[16]) {
    float o[4];
#pragma unroll
    for (int j = 0; j < 4; ++j)
        o[j] = fmaf(G5, v[j + 5], fmaf(G4, v[j + 4] + v[j + 6], fmaf(G3, v[j + 3] + v[j + 7],
               fmaf(G2, v[j + 2] + v[j + 8], fmaf(G1, v[j + 1] + v[j + 9], G0 * (v[j] + v[j + 10]))))));
    return Quad{o[0], o[1], o[2], o[3]};
}

DEVICE void load_row(const float* from, float (&v)[16]) {
#pragma unroll
    for (int j = 0; j < 4; ++j) {
        const Quad q = *reinterpret_cast<const Quad*>(from + 4 * j);
        v[4 * j] = q.a; v[4 * j + 1] = q.b; v[4 * j + 2] = q.c; v[4 * j + 3] = q.d;
    }
}

struct Stream {
    float moments[4][10], slopes[3][10];  // rows on their way through the vertical blurs
    float u[ROWS], v[ROWS];               // the next rows
    float absolute, similar;
};

template <bool L1, bool WANTED>
DEVICE void stream(const Task& k) {
    const int halo = WANTED ? 2 * REACH : REACH, core = THREADS - 2 * halo;
    SHARED float raw[3 * ROWS * PITCH];        // prediction and target, then the three slopes
    SHARED float blurred[4 * ROWS * THREADS];  // after the horizontal pass
    LANES(Stream, lanes);

    // The channels of a tile are neighbours in time, so that what they share is in the cache.
    const int tiles = (k.width + core - 1) / core, strips = (k.height + k.strip - 1) / k.strip;
    long long rest = BLOCK;
    const int channel = (int)(rest % k.channels); rest /= k.channels;
    const int left = (int)(rest % tiles) * core - halo; rest /= tiles;
    const int first = (int)(rest % strips) * k.strip;
    const long long view = rest / strips;
    const int last = first + k.strip < k.height ? first + k.strip : k.height;
    const Value* xs = plane_of(k.prediction, k.of_prediction, view, channel);
    const Value* ys = plane_of(k.target, k.of_target, view, channel);
    const float* map = L1 && k.map ? k.map + view * k.map_view : 0;
    float* slopes = k.gradient + (WANTED ? view * k.of_gradient.view + channel * k.of_gradient.channel : 0);
    const float values = (float)k.views * k.channels * k.height * k.width;
    const float l1_scale = L1 ? l1_step(k, values) : 0.f, ssim_scale = k.ssim_share / values;

    auto fetch = [&](Stream& lane, int t, int base) {
        const int column = left + t;
        const bool inside = column >= 0 && column < k.width;
#pragma unroll
        for (int r = 0; r < ROWS; ++r) {
            const int row = base + r;
            const bool ok = inside && row >= 0 && row < k.height && row < last + halo;
            lane.u[r] = ok ? read(xs + row * k.of_prediction.row + column * k.of_prediction.column) : 0.f;
            lane.v[r] = ok ? read(ys + row * k.of_target.row + column * k.of_target.column) : 0.f;
        }
    };

    phase(lanes, [&](Stream& lane, int t) {
#pragma unroll
        for (int j = 0; j < 10; ++j) {
            lane.moments[0][j] = lane.moments[1][j] = lane.moments[2][j] = lane.moments[3][j] = 0.f;
            lane.slopes[0][j] = lane.slopes[1][j] = lane.slopes[2][j] = 0.f;
        }
        lane.absolute = lane.similar = 0.f;
        for (int j = t; j < 3 * ROWS * PITCH; j += THREADS) raw[j] = 0.f;  // the margins stay zero
        fetch(lane, t, first - halo);
    });
    for (int base = first - halo; base < last + halo; base += ROWS) {
        phase(lanes, [&](Stream& lane, int t) {
#pragma unroll
            for (int r = 0; r < ROWS; ++r) {
                raw[r * PITCH + REACH + t] = lane.u[r];
                raw[(ROWS + r) * PITCH + REACH + t] = lane.v[r];
            }
        });
        phase(lanes, [&](Stream& lane, int t) {  // the horizontal blur: a warp a row, four columns a thread
            fetch(lane, t, base + ROWS);         // on its way meanwhile
            const int at = (t & 31) * 4, line = t >> 5;
            float u[16], v[16];
            load_row(raw + line * PITCH + at, u);
            load_row(raw + (ROWS + line) * PITCH + at, v);
            float* to = blurred + line * THREADS + at;
            *reinterpret_cast<Quad*>(to) = across(u);
            *reinterpret_cast<Quad*>(to + ROWS * THREADS) = across(v);
#pragma unroll
            for (int j = 0; j < 14; ++j) { const float a = u[j], b = v[j]; u[j] = fmaf(a, a, b * b); v[j] = a * b; }
            *reinterpret_cast<Quad*>(to + 2 * ROWS * THREADS) = across(u);
            *reinterpret_cast<Quad*>(to + 3 * ROWS * THREADS) = across(v);
        });
        phase(lanes, [&](Stream& lane, int t) {  // the vertical blur, and SSIM of row base + r - 5
            const int column = left + t;
            const bool inside = column >= 0 && column < k.width;
            const bool mine = t >= halo && t < halo + core && column < k.width;
#pragma unroll MOMENT_ROWS
            for (int r = 0; r < ROWS; ++r) {
                const float* from = blurred + r * THREADS + t;
                const float m1 = push(lane.moments[0], from[0]), m2 = push(lane.moments[1], from[ROWS * THREADS]);
                const float squares = push(lane.moments[2], from[2 * ROWS * THREADS]);
                const float product = push(lane.moments[3], from[3 * ROWS * THREADS]);
                const int row = base + r - REACH;
                const float m12 = m1 * m2, mm = fmaf(m1, m1, m2 * m2);
                const float a1 = fmaf(2.f, m12, 0.0001f), a2 = fmaf(2.f, product - m12, 0.0009f);
                const float d1 = mm + 0.0001f, d2 = (squares - mm) + 0.0009f;
                const float inverse = reciprocal(d1 * d2), a1_inverse = a1 * inverse, similarity = a2 * a1_inverse;
                if (mine && row >= first && row < last) lane.similar += similarity;
                if (WANTED) {
                    const bool ok = inside && row >= 0 && row < k.height;
                    const float mixed = fmaf(m2, a2 - a1, m1 * similarity * (d1 - d2));
                    raw[r * PITCH + REACH + t] = ok ? 2.f * inverse * mixed : 0.f;
                    raw[(ROWS + r) * PITCH + REACH + t] = ok ? -2.f * similarity * (d1 * inverse) : 0.f;
                    raw[(2 * ROWS + r) * PITCH + REACH + t] = ok ? 2.f * a1_inverse : 0.f;
                }
            }
            if (L1 && !WANTED) {  // a loop of its own keeps the weight's registers out of the blur's way
#pragma unroll 1
                for (int r = 0; r < ROWS; ++r) {
                    const int row = base + r - REACH;
                    if (!(mine && row >= first && row < last)) continue;
                    const float d = read(xs + row * k.of_prediction.row + column * k.of_prediction.column)
                                    - read(ys + row * k.of_target.row + column * k.of_target.column);
                    lane.absolute = fmaf(map ? map[row * k.width + column] : 1.f, fabsf(d), lane.absolute);
                }
            }
        });
        if (!WANTED) continue;
        phase(lanes, [&](Stream&, int t) {
            const int at = (t & 31) * 4, line = t >> 5;
#pragma unroll
            for (int j = 0; j < 3; ++j) {
                float v[16];
                load_row(raw + (j * ROWS + line) * PITCH + at, v);
                *reinterpret_cast<Quad*>(blurred + (j * ROWS + line) * THREADS + at) = across(v);
            }
        });
        phase(lanes, [&](Stream& lane, int t) {  // the vertical blur of the slopes, and the gradient of row base + r - 10
            const int column = left + t;
            const bool mine = t >= halo && t < halo + core && column < k.width;
            int row = base - halo, at = row * k.width + column;
            int x_at = row * k.of_prediction.row + column * k.of_prediction.column;
            int y_at = row * k.of_target.row + column * k.of_target.column;
            int slope_at = row * k.of_gradient.row + column * k.of_gradient.column;
#pragma unroll SLOPE_ROWS
            for (int r = 0; r < ROWS; ++r) {
                const float* from = blurred + r * THREADS + t;
                const float s1 = push(lane.slopes[0], from[0]), s2 = push(lane.slopes[1], from[ROWS * THREADS]);
                const float s3 = push(lane.slopes[2], from[2 * ROWS * THREADS]);
                if (mine && row >= first && row < last) {
                    const float u = read(xs + x_at), v = read(ys + y_at);
                    float slope = ssim_scale * fmaf(v, s3, fmaf(u, s2, s1));
                    if (L1) {
                        const float w = map ? map[at] : 1.f, d = u - v;
                        lane.absolute = fmaf(w, fabsf(d), lane.absolute);
                        slope = fmaf(l1_scale * w, sign(d), slope);
                    }
                    slopes[slope_at] = slope;
                }
                ++row;
                at += k.width;
                x_at += k.of_prediction.row;
                y_at += k.of_target.row;
                slope_at += k.of_gradient.row;
            }
        });
    }
    write_sums<Stream>(k, lanes, raw, [](const Stream& lane) { return lane.absolute; },
                       [](const Stream& lane) { return lane.similar; });
}

#if STENCIL == 0
KERNEL(legs_loss_gradient, 4) { stream<true, true>(k); }
KERNEL(legs_loss_value, 4) { stream<true, false>(k); }
KERNEL(legs_ssim_gradient, 4) { stream<false, true>(k); }
KERNEL(legs_ssim_value, 4) { stream<false, false>(k); }
#endif
