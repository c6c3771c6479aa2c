// legs.cu on a CPU: a block's threads run one after the other through each phase, in either order.
#include <cmath>
#include <cstring>

#define EMULATED
#define THREADS 256
#define DEVICE static inline
#define SHARED alignas(16)
#define LANES(type, name) type name[THREADS]
#define __align__(n) alignas(n)
#define BLOCK block_index
#define BLOCKS block_count
#define KERNEL(name, least_blocks)                                                  \
    static void name##_block(const Task& k);                                        \
    extern "C" void name(long long blocks, const Task* task, int backwards) {       \
        block_count = blocks;                                                       \
        reversed = backwards != 0;                                                  \
        for (block_index = 0; block_index < blocks; ++block_index) name##_block(*task); \
    }                                                                               \
    static void name##_block(const Task& k)

static long long block_index, block_count;
static bool reversed;

template <class Lane, class Body>
static inline void phase(Lane (&lanes)[THREADS], Body body) {
    for (int i = 0; i < THREADS; ++i) {
        const int t = reversed ? THREADS - 1 - i : i;
        body(lanes[t], t);
    }
}

template <class To, class From>
static inline To same_bits(From from) {
    To to;
    static_assert(sizeof to == sizeof from, "");
    std::memcpy(&to, &from, sizeof to);
    return to;
}
static inline long long whole(long long bytes) { return bytes; }
static inline int anew(int x) { return x; }
static inline float as_float(unsigned bits) { return same_bits<float>(bits); }
static inline unsigned as_bits(float value) { return same_bits<unsigned>(value); }
// The device's approximations, with the error that their makers state: one unit in the last place, up or down.
static inline float one_off(float exact) {
    const unsigned bits = as_bits(exact);
    if ((bits & 0x7fffffffu) - 1u >= 0x7f7fffffu) return exact;  // 0, infinite or no number
    return as_float((bits * 2654435761u) >> 31 ? bits + 1u : bits - 1u);
}
static inline float rough_reciprocal(float x) { return one_off(1.f / x); }
static inline float root(float x) { return one_off(std::sqrt(x)); }
static inline float saturated(float x) { return x > 0.f ? (x < 1.f ? x : 1.f) : 0.f; }
static inline float half_to_float(unsigned short bits) { return (float)same_bits<_Float16>(bits); }
static inline unsigned short float_to_half(float value) { return same_bits<unsigned short>((_Float16)value); }

#include SOURCE
extern "C" unsigned long long size_of_task() { return sizeof(Task); }
