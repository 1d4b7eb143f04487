"""Writes a small MACE model of random weights for Al and Cu: python make_mace.py FILE. Its energies mean nothing."""

from __future__ import annotations

import os
import sys

os.environ.setdefault("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")

import numpy as np
import torch


def make(path: str, seed: int = 1, layers: int = 2, cutoff: float = 4.5) -> None:
    """A model of two elements with 8 scalars and 8 vectors a layer."""
    from e3nn import o3
    from mace import modules

    torch.manual_seed(seed)
    torch.set_default_dtype(torch.float64)
    model = modules.ScaleShiftMACE(
        atomic_inter_scale=0.3,
        atomic_inter_shift=0.1,
        r_max=cutoff,
        num_bessel=6,
        num_polynomial_cutoff=5,
        max_ell=2,
        interaction_cls=modules.interaction_classes["RealAgnosticResidualInteractionBlock"],
        interaction_cls_first=modules.interaction_classes["RealAgnosticResidualInteractionBlock"],
        num_interactions=layers,
        num_elements=2,
        hidden_irreps=o3.Irreps("8x0e + 8x1o"),
        MLP_irreps=o3.Irreps("8x0e"),
        atomic_energies=np.array([-3.0, -2.5]),
        avg_num_neighbors=12.0,
        atomic_numbers=[13, 29],
        correlation=2,
        gate=torch.nn.functional.silu,
    )
    torch.save(model, path)


if __name__ == "__main__":
    make(sys.argv[1])
