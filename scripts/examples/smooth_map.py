"""Deform any smooth map, not only a robot: the elastic two-link arm of the paper's section 5.

    python scripts/examples/smooth_map.py

k0 is any torch function (N, n) -> (N, m) whose rows do not mix. `fit` finds the two diffeomorphisms for given kernels
and noise, and reports two residuals that prove the optimum: the coupling residual |b_end - Dk0^T p| / |b_end|, and the
end residual |p_end - R^-1 (y - k1)| / |p_end| of the paper's condition (12).
"""

from __future__ import annotations

import torch

import diffeo_calib as dc
from diffeo_calib.robots import elastic_rr


def main() -> None:
    """Fit in several ways."""
    x = elastic_rr.grid(16)  # (256, 2) rad
    y = elastic_rr.real(x)  # (256, 2) measured positions
    K_V = dc.VonMises(concentration=(1.0186, 1.0186), variance=8.0)  # 8 exp(sum_l b_l (cos d_l - 1)) on joint space
    K_W = dc.Gaussian(lengthscale=0.5135**0.5)  # exp(-|d|^2 / 1.0270) on task space
    problem = dc.Problem(elastic_rr.nominal, x, y, joint_kernel=K_V, task_kernel=K_W, noise=0.01)

    others = 2 * torch.pi * torch.rand(3000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    nominal = (elastic_rr.nominal(others) - elastic_rr.real(others)).norm(dim=1).mean()

    def show(what: str, fit: dc.Fit) -> None:
        error = (fit.model(others) - elastic_rr.real(others)).norm(dim=1).mean()
        residuals = f"coupling {fit.coupling_residual:.1e}, end {fit.end_residual:.1e}"
        print(f"{what:28} {nominal:.3f} -> {error:.1e}; energy {fit.energy:.6f}; {residuals}; {fit.seconds:.2f} s")

    # Gauss-Newton, time steps chosen so that their error is below 1 % of the noise.
    fit = dc.fit(problem)
    show("Gauss-Newton", fit)
    print(fit.status)

    # The solver of the paper's framework; it starts from Gauss-Newton's solution here and stays at the same optimum.
    show("L-BFGS from there", dc.fit(problem, dc.LBFGS(max_iterations=20), fit.integrator, start=fit.momenta))

    # torchdiffeq's integrators, with its continuous adjoint for the gradients.
    adjoint = dc.TorchDiffEq("rk4", adjoint=True, step_size=0.5)
    show("L-BFGS, adjoint", dc.fit(problem, dc.LBFGS(max_iterations=10), adjoint))

    # A coarse model: 100 of the configurations carry momenta, all 256 are fitted. The residuals are not defined then.
    show("100 control points", dc.fit(problem, controls=100))

    # No N m x N m matrix: conjugate gradients on kernel sums, the default beyond 8000 coordinates.
    show("conjugate gradients", dc.fit(problem, dc.GaussNewton(linear="cg"), dc.RK4(4)))

    # The model: call, exact Jacobian, posterior covariance.
    model = fit.model
    mean, covariance = model.predict(others[:5])
    print(mean.shape, covariance.shape, model.jacobian(others[:5]).shape)


if __name__ == "__main__":
    main()
