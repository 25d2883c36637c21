"""The paper's own formulation: equations (16)-(20), its two algorithms, and what their errata cost.

    python scripts/examples/paper.py

R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025.
`formulation="eulerian"` follows k, P and Dk at the fixed measured configurations, as the paper does. It is kept for
comparison: it has no `predict` and cannot be saved.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "paper_arm"))  # for section 5 and its listings

from listings import Descent, evaluate, lr_calibration
from section_5 import section_5

import diffeo_calib as dc


def main() -> None:
    """Fit the elastic arm of section 5 exactly, as corrected, and as printed."""
    problem = section_5(sigma=0.01, k=8)  # the paper's grid is k=16
    exact = dc.fit(problem, integrator=dc.RK4(2))
    solver = dc.LBFGS(max_iterations=60, tolerance=1e-4)
    corrected = dc.fit(problem, solver, dc.RK4(2), formulation="eulerian")
    printed = dc.fit(problem, solver, dc.RK4(2), formulation="eulerian", printed_sign=True)
    for name, fit in {"exact": exact, "eulerian": corrected, "printed sign of (11), (17)": printed}.items():
        print(f"{name:28} energy (16) {fit.energy:.5f} after {fit.evaluations} evaluations: {fit.status}")

    # Listings 1 and 2, to be read beside benchmarks/paper_arm/listings.py.
    k0, K_V, K_W = problem.spec.nominal, problem.spec.joint_kernel, problem.spec.task_kernel
    found = lr_calibration(problem.x, problem.y, k0, K_V, K_W, 0.01, Descent(mu=3e-10, epsilon=1.0, max_iter=20))
    k1, Dk1 = evaluate(problem.x[:5], *found)
    before, after = ((problem.y[:5] - k).norm(dim=1).mean() for k in (k0(problem.x[:5], problem.x.new_zeros(0)), k1))
    print(f"20 steps of Algorithm 1: mean error {before:.4f} -> {after:.4f}; Dk1 {tuple(Dk1.shape)}")


if __name__ == "__main__":
    main()
