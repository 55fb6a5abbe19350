"""Makes ``nil`` and the sensors known to every Mitsuba variant, whenever it is set."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

import mitsuba as mi

from . import llvm

# Modules that keep types of the current variant, each after those it imports from.
VARIANT_MODULES = (
    "nil_mitsuba.quotient",
    "nil_mitsuba.shapes",
    "nil_mitsuba.triangles",
    "nil_mitsuba.box",
    "nil_mitsuba.clearance",
    "nil_mitsuba.tracer",
    "nil_mitsuba.interaction",
    "nil_mitsuba.camera",
    "nil_mitsuba.lights",
    "nil_mitsuba.media",
    "nil_mitsuba.view",
    "nil_mitsuba.volumetric",
    "nil_mitsuba.passes",
    "nil_mitsuba.integrator",
)

# Loaded by those who need it, and then anew with each variant.
PREVIEW_MODULE = "nil_mitsuba.preview"

# The sensors are for any integrator, and so for the variants, too, that cannot run "nil".
SENSORS_MODULE = "nil_mitsuba.sensors"

WORKING_VARIANT = "llvm_ad_rgb"


def install() -> None:
    """Register ``nil`` in the current variant, if one is set, and in each one set from now on.

    Calling it again changes nothing. Raises ImportError if the current variant needs an LLVM that
    is not there.
    """
    if not any(isinstance(finder, llvm.Guard) for finder in sys.meta_path):
        sys.meta_path.insert(0, llvm.Guard())
    if mi.variant() is not None:
        _register(None, mi.variant())
    mi.detail.add_variant_callback(_register)  # a set: the same callback is kept once


def refusal(variant: str) -> str | None:
    """One sentence on why `variant` cannot run the integrator, or None if it can."""
    if variant.startswith("scalar_"):
        kind = "a scalar variant, which traces one ray at a time in C++"
    elif variant.endswith("_polarized"):
        kind = "a polarized variant, and polarization is not supported"
    else:
        return None
    return (
        f'the integrator "nil" cannot run in {variant} ({kind}): '
        f'use for example the variant "{WORKING_VARIANT}".'
    )


def _register(_old: str | None, variant: str) -> None:
    # A variant loaded before this package was imported does not pass by the import guard again.
    llvm.require(variant)

    # Looked up on each call: classes are others after each reload.
    for name in _loaded(SENSORS_MODULE).SENSORS:
        mi.register_sensor(
            name, lambda props, name=name: sys.modules[SENSORS_MODULE].SENSORS[name](props)
        )

    sentence = refusal(variant)
    if sentence:

        def construct(_props):
            raise RuntimeError(sentence)
    else:
        for name in VARIANT_MODULES:
            _loaded(name)
        if PREVIEW_MODULE in sys.modules:
            _loaded(PREVIEW_MODULE)

        def construct(props):
            return sys.modules["nil_mitsuba.integrator"].NilIntegrator(props)

    mi.register_integrator("nil", construct)


def _loaded(name: str) -> ModuleType:
    """A module with the types of the current variant."""
    if name in sys.modules:
        return importlib.reload(sys.modules[name])
    return importlib.import_module(name)
