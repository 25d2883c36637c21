"""Where tensors live: one policy for the whole package.

* Constants, files, tables, robots and the front half of a calibration (registration, geometry, choice of scales) are on
  the CPU: small work, and SciPy does some of it.
* Flows and kernel sums run where their inputs are: move a problem or a model with ``.to(device)``.
* No tensor is made without a device: either that of an input or :data:`HOST`. Then ``torch.set_default_device`` of the
  user's program changes nothing here.
"""

from __future__ import annotations

import torch

HOST = torch.device("cpu")


def seeded(seed: int) -> torch.Generator:
    """A random generator on the CPU: the same numbers whatever the device of the work."""
    return torch.Generator(HOST).manual_seed(seed)
