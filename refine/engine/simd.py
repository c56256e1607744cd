"""What numba is told, and exp and log in a form that it can turn into vector instructions.

Calls into the mathematics library end vectorisation. In float64, which only tests and the careful use, they
are called all the same.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, no_type_check

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic, overload

# contract: multiply-adds; ninf, afn: no care for infinities; nsz: the sign of zero never matters. No
# reassociation: cross products live from the order of operations.
_FAST = {"contract", "nsz", "ninf", "afn"}
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_INLINE: dict[str, Any] = {**_OPTIONS, "forceinline": True}

_LOG2_E, _LN2 = np.float32(1.0 / math.log(2.0)), np.float32(math.log(2.0))
# 2^r for |r| <= 1/2, to 8e-8; ln((1 + s) / (1 - s)) / s as a polynomial in s^2.
_EXP2 = tuple(
    np.float32(c)
    for c in np.polynomial.Chebyshev.interpolate(np.exp2, 5, [-0.5, 0.5])
    .convert(kind=np.polynomial.Polynomial)
    .coef
)
_ATANH = tuple(np.float32(2.0 / (2 * k + 1)) for k in range(6))
_SQRT2 = np.float32(math.sqrt(2.0))
_ZERO, _HALF_F, _ONE = (np.float32(x) for x in (0.0, 0.5, 1.0))
_LARGEST_EXPONENT = 79.0
_LARGEST_EXPONENT2, _ROUNDER = np.float32(_LARGEST_EXPONENT / math.log(2.0)), np.float32(1.5 * 2**23)
_SHIFT, _BIAS = np.int32(23), np.int32(127)


SOURCES = ("simd.py", "shading.py", "kernel.py", "normal_equations.py")
"""Files whose functions others inline."""


def compiled(function: Callable[..., Any]) -> Any:
    """Compile when first called, to be inlined into what is kept."""
    return numba.njit(fastmath=_FAST, **_INLINE)(function)


def estimated(function: Callable[..., Any]) -> Any:
    """Compile likewise, but divide by a refined estimate of the reciprocal, to 1 ulp or 2.

    That keeps the processor's divider free, which matters where there are square roots, too, and only there.
    """
    return numba.njit(fastmath=_FAST | {"arcp"}, **_INLINE)(function)


def reordered(function: Callable[..., Any]) -> Any:
    """Compile likewise, but leave the order of additions to the compiler."""
    return numba.njit(fastmath=_FAST | {"reassoc"}, **_INLINE)(function)


def kept(function: Callable[..., Any]) -> Any:
    """Compile and keep the result on disk; only in memory where there is no place to write at all.

    Numba notices changes of the function's own file by its date. The digest in the name makes it notice those
    of the files it is inlined from, too, and versions of the package whose files have the same date.
    """
    files = [*(Path(__file__).with_name(name) for name in SOURCES), Path(function.__code__.co_filename)]
    sources = b"".join(file.read_bytes() for file in files)
    function.__qualname__ = f"{function.__name__}_{zlib.crc32(sources):08x}"
    try:
        return numba.njit(fastmath=_FAST, cache=True, **_OPTIONS)(function)
    except RuntimeError:  # numba finds neither the package's folder nor the user's cache writable
        return compiled(function)


def not_kept(dispatcher: Any) -> Any:
    """Return the same function, to be compiled anew and kept nowhere."""
    return compiled(dispatcher.py_func)


def _either(name: str) -> Any:
    """Return a function of two floating-point numbers that is one of LLVM's own.

    Two comparisons in a row would do, but LLVM joins them to what is no longer a minimum and a maximum.
    """

    def typed(typing_context: Any, a: types.Float, b: types.Float) -> tuple[Any, Any]:
        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            kind = arguments[0].type
            function = builder.module.declare_intrinsic(name, [kind], ir.FunctionType(kind, [kind, kind]))
            return builder.call(function, arguments)

        return a(a, a), generate

    return intrinsic(typed)


lesser, greater = _either("llvm.minnum"), _either("llvm.maxnum")


@no_type_check
def exp(x):
    """e^x, where numba compiles; of |x| > 79 that of 79, so that neither it nor its inverse is infinite."""
    raise NotImplementedError


@no_type_check
def log(x):
    """Natural logarithm of a normal positive number, where numba compiles."""
    raise NotImplementedError


@overload(exp, jit_options={"fastmath": _FAST})
@no_type_check
def _exp_of(x):
    """e^x as 2^n 2^r with whole n and |r| <= 1/2; n is added to the exponent's bits.

    The sum with `_ROUNDER` has no bits left behind the point, and n in its lowest ones.
    """
    if x == types.float64:
        return lambda x: math.exp(greater(lesser(x, _LARGEST_EXPONENT), -_LARGEST_EXPONENT))

    @no_type_check
    def polynomial(x):
        y = greater(lesser(x * _LOG2_E, _LARGEST_EXPONENT2), -_LARGEST_EXPONENT2)
        rounded = y + _ROUNDER
        r = y - (rounded - _ROUNDER)
        total = _EXP2[5] * r + _EXP2[4]
        total = total * r + _EXP2[3]
        total = total * r + _EXP2[2]
        total = total * r + _EXP2[1]
        total = total * r + _EXP2[0]
        n = np.float32(rounded).view(np.int32) << _SHIFT
        return np.int32(np.float32(total).view(np.int32) + n).view(np.float32)

    return polynomial


@overload(log, jit_options={"fastmath": _FAST})
@no_type_check
def _log_of(x):
    """Natural logarithm of a normal positive number: `ln 2^e m = e ln 2 + 2 atanh((m-1)/(m+1))`.

    m is in [sqrt(1/2), sqrt(2)], so the argument of atanh is at most 0.172: six terms suffice.
    """
    if x == types.float64:
        return lambda x: math.log(x)

    @no_type_check
    def polynomial(x):
        bits = np.float32(x).view(np.int32)
        exponent = np.int32((bits >> _SHIFT) - _BIAS)
        mantissa = np.int32((bits & np.int32(0x007FFFFF)) | np.int32(0x3F800000)).view(np.float32)
        large = mantissa > _SQRT2
        mantissa = mantissa * _HALF_F if large else mantissa
        e = np.float32(exponent) + (_ONE if large else _ZERO)
        s = (mantissa - _ONE) / (mantissa + _ONE)
        s2 = s * s
        total = _ATANH[5]
        total = total * s2 + _ATANH[4]
        total = total * s2 + _ATANH[3]
        total = total * s2 + _ATANH[2]
        total = total * s2 + _ATANH[1]
        total = total * s2 + _ATANH[0]
        return total * s + e * _LN2

    return polynomial
