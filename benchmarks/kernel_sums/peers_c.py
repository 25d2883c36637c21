"""A peer in C as a method, see landmarks.py: what a compiler makes of fused loops, the limit for compiled Python.

Loops over pairs i < j in bands of 512 columns, so that a band's sums stay in the cache; points and momenta by columns,
one thread. Compiled by gcc with -O3 -march=native -ffast-math, whose exponentials are those of libmvec. At small sizes
this is not a limit in the strict sense: sums over j are stored for every row i.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import torch
from landmarks import LENGTHSCALE, Method
from torch import Tensor

SOURCE = r"""
#include <math.h>
#define BAND 512
/* out: v, and slopes sum_j K_ij (p_i . p_j) (q_i - q_j), (3, n) each; slopes may be null. c = -1 / (2 l^2). */
void pairs(const double *restrict q, const double *restrict p, double *restrict v, double *restrict s, long n, double c)
{
    const double *q0 = q, *q1 = q + n, *q2 = q + 2 * n, *p0 = p, *p1 = p + n, *p2 = p + 2 * n;
    double *restrict v0 = v, *restrict v1 = v + n, *restrict v2 = v + 2 * n;
    for (long k = 0; k < 3 * n; k++) v[k] = p[k];
    if (s) for (long k = 0; k < 3 * n; k++) s[k] = 0;
    for (long band = 0; band < n; band += BAND) {
        long end = band + BAND < n ? band + BAND : n;
        for (long i = 0; i < end; i++) {
            double x0 = q0[i], x1 = q1[i], x2 = q2[i], a0 = p0[i], a1 = p1[i], a2 = p2[i];
            double t0 = 0, t1 = 0, t2 = 0, u0 = 0, u1 = 0, u2 = 0;
            long first = i + 1 > band ? i + 1 : band;
            if (!s)
                for (long j = first; j < end; j++) {
                    double d0 = q0[j] - x0, d1 = q1[j] - x1, d2 = q2[j] - x2;
                    double k = exp(c * (d0 * d0 + d1 * d1 + d2 * d2));
                    t0 += k * p0[j]; t1 += k * p1[j]; t2 += k * p2[j];
                    v0[j] += k * a0; v1[j] += k * a1; v2[j] += k * a2;
                }
            else {
                double *restrict s0 = s, *restrict s1 = s + n, *restrict s2 = s + 2 * n;
                for (long j = first; j < end; j++) {
                    double d0 = q0[j] - x0, d1 = q1[j] - x1, d2 = q2[j] - x2;
                    double k = exp(c * (d0 * d0 + d1 * d1 + d2 * d2));
                    double w = k * (a0 * p0[j] + a1 * p1[j] + a2 * p2[j]);
                    t0 += k * p0[j]; t1 += k * p1[j]; t2 += k * p2[j];
                    u0 -= w * d0; u1 -= w * d1; u2 -= w * d2;
                    v0[j] += k * a0; v1[j] += k * a1; v2[j] += k * a2;
                    s0[j] += w * d0; s1[j] += w * d1; s2[j] += w * d2;
                }
                s0[i] += u0; s1[i] += u1; s2[i] += u2;
            }
            v0[i] += t0; v1[i] += t1; v2[i] += t2;
        }
    }
}
"""
FLAGS = ("-O3", "-march=native", "-ffast-math", "-shared", "-fPIC")
DIM = 3


def library() -> ctypes.CDLL:
    """Compile the loops; raises RuntimeError where no gcc is found."""
    compiler = shutil.which("gcc")
    if compiler is None:
        raise RuntimeError("the C peer needs gcc")
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "pairs.c"), Path(folder, "pairs.so")
        source.write_text(SOURCE)
        subprocess.run([compiler, *FLAGS, str(source), "-o", str(target), "-lm"], check=True)
        return ctypes.CDLL(str(target))


class C(Method):
    """Fused loops in C, three coordinates, one thread."""

    tasks: ClassVar[tuple[str, ...]] = ("sum", "rhs")

    def compile(self, task: str, steps: int) -> None:
        """Compile the loops."""
        if self.data.q.shape[1] != DIM:
            raise NotImplementedError("the C peer is written for three coordinates")
        self.loops = library()

    def function(self, task: str, steps: int) -> Callable[[], list[Tensor]]:
        """Return a call on columns, with rows again as its results."""
        n = len(self.data.q)

        def timed() -> list[Tensor]:
            q, p = (t.T.contiguous() for t in (self.data.q, self.data.p))
            v, slopes = torch.empty_like(q), torch.empty_like(q)
            addresses = [ctypes.c_void_p(t.data_ptr()) for t in (q, p, v, slopes)]
            if task == "sum":
                addresses[-1] = ctypes.c_void_p(None)
            self.loops.pairs(*addresses, ctypes.c_long(n), ctypes.c_double(-0.5 / LENGTHSCALE**2))
            return [v.T] if task == "sum" else [v.T, slopes.T * (-1.0 / LENGTHSCALE**2)]

        return timed

    def endpoint(self, steps: int) -> Tensor:
        """Not offered."""
        raise NotImplementedError

    def threads(self) -> int:
        """One."""
        return 1
