"""Writes two_layers.npz and three_layers.npz: exports of small models, cut down further.

    python small_models.py MODELS

MODELS holds grace2l_tiny and grace3l_tiny. Two of four elements stay, fewer hidden units and products
(two layers) or channels (three layers), and a projection to few features, so the energies mean nothing;
every kind of array that a reader meets is there.
"""

import sys
from pathlib import Path

import numpy as np

ELEMENTS, HIDDEN, CHANNELS, FEATURES = [0, 3], 8, 2, 6


def elements(key, array):
    by_element = "_reduce_" in key and array.ndim == 4
    named = key in ("chem_embedding", "shift_values", "element_names")
    return array[ELEMENTS] if by_element or named else array


def write(name, model, n_blocks, d_basis):
    model = {key: elements(key, array) for key, array in model.items() if not key.startswith("uq_")}
    for key in model:
        if key == "n_elements" or key.endswith("_number_of_atom_types"):
            model[key] = np.array([len(ELEMENTS)])
    random = np.random.default_rng(1)
    model |= {
        "uq_schema_version": np.array([6]),
        "uq_rp_dim": np.array([FEATURES]),
        "uq_feature_dim": np.array([FEATURES + 1 + n_blocks]),
        "uq_rp_matrix": (random.standard_normal((d_basis, FEATURES)) / FEATURES**0.5).astype(np.float32),
        "uq_rp_normalize": np.array([1]),
        "uq_rp_add_density_channel": np.array([1]),
    }
    np.savez_compressed(Path(__file__).with_name(name), **model)


def two_layers(model):
    """Without AAAA and BBBB, and with small networks and few channels of I1."""
    dropped = ("AAAA", "BBBB", "fc_AA2", "fc_BB2")
    model = {k: a for k, a in model.items() if not any(name in k for name in dropped)}
    for key, array in model.items():
        if key.endswith("_instruction_names"):
            model[key] = array[(array != b"AAAA") & (array != b"BBBB")]
        if key.startswith("I1_reduce_") and key.endswith("_W"):
            model[key] = array[:, :CHANNELS]
        if key.startswith("mlp_rad_R") and "_W" in key:
            last = int(key[-1]) == 2
            model[key] = array[: array.shape[0] if key[-1] == "0" else HIDDEN, : None if last else HIDDEN]
    model["I_reduce_I1_W"] = model["I_reduce_I1_W"][:, :CHANNELS]
    model["I_n_in_I1"] = model["I1_n_out"] = np.array([CHANNELS])
    model["energy_mlp_W0"] = model["energy_mlp_W0"][:, :HIDDEN]
    model["energy_mlp_W1"] = model["energy_mlp_W1"][:HIDDEN]
    for key in ("fc_names", "prod_names"):
        model[key] = np.array([name for name in model[key] if name not in (b"AAAA", b"BBBB", b"AA2", b"BB2")])
    d_basis = sum(
        int(model[f"{block}_n_in_{source.decode()}"][0]) * model[f"{block}_collect_ind_{source.decode()}"].size
        for block in ("I_out_0", "I_out_1")
        for source in model[f"{block}_instruction_names"]
    )
    write("two_layers.npz", model, 2, d_basis)


def three_layers(model):
    c = CHANNELS
    for key, array in model.items():
        if key.endswith("_mlp_W2"):
            n = int(model[key.replace("_mlp_W2", "_n_rad_max")][0])
            model[key] = array.reshape(array.shape[0], n, -1)[:, :c].reshape(array.shape[0], -1)
        elif key.endswith(("lin_transform_W", "chem_linear_W", "affine_weight")):
            model[key] = array[:, :c]
        elif key.endswith(("_U", "_V")) or key.startswith("fc_") and key.endswith("_w_right"):
            model[key] = array[..., :c, :c] if key[-1] in "UV" else array[:c, :c]
        elif "_reduce_" in key and key.endswith("_W"):
            model[key] = array[..., :c, :] if key.startswith("rho") else array[..., :c, :c, :]
    for key in model:
        is_channels = key.endswith(("_rank", "_n_left", "_n_right", "_n_rad_max")) or "_n_in_" in key
        if is_channels or key.endswith("_n_out") and not key.startswith(("rho", "energy")):
            model[key] = np.array([c])
    write("three_layers.npz", model, 3, 12 * c)


models = Path(sys.argv[1])
two_layers(dict(np.load(models / "grace2l_tiny/kokkos.npz")))
three_layers(dict(np.load(models / "grace3l_tiny/kokkos.npz")))
