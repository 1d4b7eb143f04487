"""What a campaign holds, as plain data."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from .blocks import Floats, Structure


@dataclass(frozen=True)
class ConstantPressure:
    """The conditions of a walk at constant pressure."""

    pressure: float
    """bar"""
    start_volume: float
    """V/V₀ at its first step."""
    cell_bias: bool
    """Whether its cell is biased."""


@dataclass(frozen=True)
class WalkConditions:
    """The conditions of a walk."""

    group: str
    """Its group of walks; empty without groups."""
    temperature: float
    """Of the thermostat, K."""
    tau: float
    """Uncertainty-force scale τ at its start."""
    volume_ramp: tuple[float, float] | None
    """V/V₀ at the first and at the last biased step; None for a fixed cell, or one at constant pressure."""
    constant_pressure: ConstantPressure | None
    """Of a walk with a barostat."""
    repeat: int
    """Number among the walks under the same conditions, from 0."""
    version: int
    """Version of the potential that drives it; 0 is that of the configuration."""


@dataclass(frozen=True)
class Label:
    """A result of a reference calculation."""

    number: int
    structure: int
    """Number of its structure in the store."""
    protocol: str
    """Name of the protocol."""
    protocol_hash: str
    """BLAKE3 of everything that changes a label's value."""
    status: str
    """`label`, `check`, `superseded` or `excluded`."""
    energy: float
    """eV; the free energy with smearing."""
    forces: Floats
    """[n, 3], eV/Å."""
    stress: Floats | None
    """[3, 3], eV/Å³, tension positive."""
    details: dict[str, Any]
    """What else is known: `energy_without_smearing`, `magnetic_moments`, `magnetisation`, `retry_adjustments` …"""
    job: int | None
    attempt: int | None
    file: str | None
    """File of an imported label."""
    frame: int | None
    """Frame in it, from 0."""
    received: int
    """ms since 1970."""
    reason: str | None
    """Why it was superseded or excluded."""


@dataclass(frozen=True)
class Candidate:
    """A structure that a walk offered, and the decision on it."""

    decision: int
    """Sequence number of the decision."""
    id: str
    fate: str
    """`accepted` or `declined`."""
    reason: str | None
    """Why it was declined."""
    origin: str
    """`biased` or `control`."""
    walk: int
    segment: int
    step: int
    seed_structure: int
    """Index of the seed structure."""
    seed_structure_name: str
    conditions: WalkConditions | None
    mixture_version_seen: int
    """Of the mixture that the walker used."""
    mixture_version: int
    """After the decision."""
    temperature: float
    """Kinetic temperature, K."""
    relative_volume: float
    """V / V₀."""
    energy: float
    """Of the potential, without bias and ZBL, eV."""
    virial: Floats
    """−∂E/∂ε of the potential, [3, 3], eV."""
    structure: Structure
    forces: Floats
    """Of the potential, [n, 3], eV/Å."""
    walker_gamma: Floats
    """γ under the walker's mixture, [n]; the selector's and the original one follow."""
    walker_gamma_nbr: Floats
    selector_gamma: Floats | None
    selector_gamma_nbr: Floats | None
    original_gamma: Floats | None
    original_gamma_nbr: Floats | None
    features: Floats | None
    """[n, D]; None unless asked for, or if they were not kept."""
    label: Label | None


@dataclass(frozen=True)
class Imported:
    """A structure that was imported from a file."""

    number: int
    structure: Structure
    file: str
    frame: int
    label: Label | None


@dataclass(frozen=True)
class SeedStructure:
    """A structure where walks start."""

    index: int
    name: str
    source: str
    """The file it came from."""
    structure: Structure


@dataclass(frozen=True)
class Walk:
    """The state of a walk. Numbers that are not finite are None."""

    walk: int
    origin: str
    partner: int | None
    """The biased walk that a control matches."""
    seed_structure: int
    seed_structure_name: str
    conditions: WalkConditions | None
    state: str
    """`waiting`, `running`, or how it ended."""
    reason: str
    assignments: int
    accepted: int
    step: int
    segment: int
    tau: float | None
    temperature: float | None
    relative_volume: float | None
    gamma_max: float | None
    rejected: int
    rollbacks: int
    reference_volume: float | None = None
    """V₀ of a walk at constant pressure from its first step on, Å³ (Å² for a slab, Å for a wire)."""


@dataclass(frozen=True)
class LabelProtocol:
    """The settings that make labels comparable."""

    number: int
    hash: str
    name: str
    settings: dict[str, Any]


@dataclass(frozen=True)
class Version:
    """A version of the potential, or an attempt at one that was refused."""

    number: int
    parent: int
    state: str
    """`registered` or `refused`."""
    reason: str
    method: str
    structures: int
    last_decision: int
    labels: int
    model_hash: str
    mixture_hash: str
    figures: dict[str, Any]
    """Errors by data set."""
    seconds: float
    core_hours: float
    time: int
    """ms since 1970."""


@dataclass(frozen=True)
class Decision:
    """An entry of the decision log."""

    sequence: int
    round: int
    kind: str
    walk: int | None
    candidate: str | None
    mixture_version: int
    """After the decision."""
    detail: dict[str, Any] = field(default_factory=dict)
