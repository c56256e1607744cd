"""What numba is told, and exp, log and square root in a form that it can turn into vector instructions.

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
from numba import types
from numba.extending import overload

# contract: multiply-adds; arcp, afn, ninf: division by a refined estimate of the reciprocal, to 1 ulp or 2;
# nsz: the sign of zero never matters. No reassociation: cross products live from the order of operations.
_FAST = {"contract", "arcp", "nsz", "ninf", "afn"}
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}

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
_ZERO, _HALF_F, _ONE, _THREE_HALVES = (np.float32(x) for x in (0.0, 0.5, 1.0, 1.5))
_SHIFT, _BIAS = np.int32(23), np.int32(127)


def compiled(function: Callable[..., Any]) -> Any:
    """Compile when first called, to be inlined into what is kept."""
    return numba.njit(fastmath=_FAST, **_OPTIONS)(function)


def reordered(function: Callable[..., Any]) -> Any:
    """Compile likewise, but leave the order of additions to the compiler."""
    return numba.njit(fastmath=_FAST | {"reassoc"}, **_OPTIONS)(function)


def kept(function: Callable[..., Any]) -> Any:
    """Compile and keep the result on disk; only in memory where there is no place to write at all.

    Numba notices changes of the function's own file by its date. The digest in the name makes it notice those
    of this file, too, and versions of the package whose files have the same date.
    """
    sources = Path(__file__).read_bytes() + Path(function.__code__.co_filename).read_bytes()
    function.__qualname__ = f"{function.__name__}_{zlib.crc32(sources):08x}"
    try:
        return numba.njit(fastmath=_FAST, cache=True, **_OPTIONS)(function)
    except RuntimeError:  # numba finds neither the package's folder nor the user's cache writable
        return compiled(function)


def not_kept(dispatcher: Any) -> Any:
    """Return the same function, to be compiled anew and kept nowhere."""
    return compiled(dispatcher.py_func)


@no_type_check
def exp(x):
    """e^x for |x| <= 80, where numba compiles."""
    raise NotImplementedError


@no_type_check
def log(x):
    """Natural logarithm of a normal positive number, where numba compiles."""
    raise NotImplementedError


@no_type_check
def root(x):
    """Square root, where numba compiles."""
    raise NotImplementedError


@overload(exp, jit_options={"fastmath": _FAST})
@no_type_check
def _exp_of(x):
    """e^x for |x| <= 80, as 2^n 2^r with whole n, which is added to the exponent's bits, and |r| <= 1/2."""
    if x == types.float64:
        return lambda x: math.exp(x)

    @no_type_check
    def polynomial(x):
        y = x * _LOG2_E
        n = np.rint(y)
        r = y - n
        total = _EXP2[5] * r + _EXP2[4]
        total = total * r + _EXP2[3]
        total = total * r + _EXP2[2]
        total = total * r + _EXP2[1]
        total = total * r + _EXP2[0]
        return np.int32(np.float32(total).view(np.int32) + (np.int32(n) << _SHIFT)).view(np.float32)

    return polynomial


@overload(root, jit_options={"fastmath": _FAST})
@no_type_check
def _root_of(x):
    """Square root, of 0 too: x / sqrt(x) by Newton's method from a first guess that halves the exponent.

    Faster than the processor's own, which does not overlap with other work.
    """
    if x == types.float64:
        return lambda x: math.sqrt(x)

    @no_type_check
    def newton(x):
        half = _HALF_F * x
        y = np.int32(np.int32(0x5F3759DF) - (np.float32(x).view(np.int32) >> np.int32(1))).view(np.float32)
        y = y * (_THREE_HALVES - half * y * y)
        y = y * (_THREE_HALVES - half * y * y)
        y = y * (_THREE_HALVES - half * y * y)
        return x * y

    return newton


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
