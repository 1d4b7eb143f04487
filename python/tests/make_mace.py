"""Writes a MACE model of random weights for Al and Cu: python make_mace.py FILE [SIZE]. Its energies mean nothing.

SIZE is `tiny` (for tests, the default), or `small`: the hyperparameters of the small MACE-MP-0 model, but for two elements.
"""

from __future__ import annotations

import os
import sys

os.environ.setdefault("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")

import numpy as np
import torch


SIZES = {
    "tiny": {"hidden": "8x0e + 8x1o", "readout": "8x0e", "num_bessel": 6, "max_ell": 2, "correlation": 2, "cutoff": 4.5},
    "small": {"hidden": "128x0e", "readout": "16x0e", "num_bessel": 10, "max_ell": 3, "correlation": 3, "cutoff": 6.0},
}


def make(path: str, seed: int = 1, layers: int = 2, size: str = "tiny") -> None:
    """A model of two elements."""
    from e3nn import o3
    from mace import modules

    chosen = SIZES[size]
    torch.manual_seed(seed)
    torch.set_default_dtype(torch.float64)
    model = modules.ScaleShiftMACE(
        atomic_inter_scale=0.3,
        atomic_inter_shift=0.1,
        r_max=chosen["cutoff"],
        num_bessel=chosen["num_bessel"],
        num_polynomial_cutoff=5,
        max_ell=chosen["max_ell"],
        interaction_cls=modules.interaction_classes["RealAgnosticResidualInteractionBlock"],
        interaction_cls_first=modules.interaction_classes["RealAgnosticResidualInteractionBlock"],
        num_interactions=layers,
        num_elements=2,
        hidden_irreps=o3.Irreps(chosen["hidden"]),
        MLP_irreps=o3.Irreps(chosen["readout"]),
        atomic_energies=np.array([-3.0, -2.5]),
        avg_num_neighbors=12.0,
        atomic_numbers=[13, 29],
        correlation=chosen["correlation"],
        gate=torch.nn.functional.silu,
    )
    torch.save(model, path)


if __name__ == "__main__":
    make(sys.argv[1], size=sys.argv[2] if len(sys.argv) > 2 else "tiny")
