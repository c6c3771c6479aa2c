"""Eight float32 or int32 at once, as types that compiled functions compute with: for the CPU rasterizers and Adam.

LLVM's own vectoriser gives up on loops that read more than a few rows: it cannot show in time that they do not overlap.
The rasterizer's blending as plain loops took 10 times as long forward, 11 backward (AMD EPYC, one thread;
``python -m benchmarks.vectors``). Here the vectors are written down, and LLVM maps them to what the processor has (AVX,
two halves of SSE or NEON).

`+ - * /` and comparisons do as IEEE says, each by itself, but for what the caller's `fastmath` allows, whose flags they
get; `multiply_add` may round once. vectors.py has the types, memory.py loads and stores, arithmetic.py works lane by
lane, lanes.py across lanes.
"""
