"""All that naibu uses of Numba and llvmlite beyond their public interfaces.

`compilation` compiles kernels and keeps them in files named by what their machine code depends on; `intrinsics` write LLVM instructions,
and `thread_pool` is made of them. Each has a plain substitute for versions of Numba where it does not work (`versions`).
"""
