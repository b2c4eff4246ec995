"""The freeze's steps and terms, each with its neutral replacement when it is switched off.

A step is switched off in this process only: a neutral function replaces a name of a module. A term of a frame is a
number of `CompositeConfig` that gets a neutral value; dots lead to nested numbers (`state.weights.change`). This is the
only file of the bench that depends on the freeze's internals.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torch_backend.freeze.composite.config import CompositeConfig
from torch_backend.freeze.frozen import FrozenGaussians
from torch_backend.freeze.instant.develop import DevelopConfig
from torch_backend.freeze.instant.static_baseline import StaticBaselineConfig

FRAME = "frame"
"""Stage of the rules that affect each frame; all other stages make the instant."""
STAGES = ("apply_static_baseline", "with_missing", "develop")
"""Names of the steps that make an instant in `torch_backend.freeze.instant.repairs`, in their order."""
MAKER = "instant.repairs"


@dataclass(frozen=True)
class Switch:
    """One name that is replaced while a rule is off."""

    module: str
    """Module of `torch_backend.freeze`."""
    name: str
    """Name in the module, with a dot for a method of a class."""
    neutral: Callable[..., Any]
    """The replacement."""
    of_original: bool = False
    """True if `neutral` takes the original and returns the replacement."""


@dataclass(frozen=True)
class Rule:
    """One rule or term of the freeze."""

    name: str
    """Short name, as in the table."""
    effect: str
    """What happens when it is off."""
    stage: str = FRAME
    """Step in which it acts: one of `STAGES`, or `FRAME`."""
    switches: tuple[Switch, ...] = ()
    """Names to replace."""
    numbers: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Fields of `CompositeConfig`, with dots for nested fields, and their neutral values."""


# ---------------------------------------------------------------------------------------------- neutral replacements


def _none(*_: Any, **__: Any) -> None:
    """None: no finding."""


def _third(*args: Any, **_: Any) -> Any:
    """The frozen scene of `(run, scene, frozen, ...)`, unchanged."""
    return args[2]


def _developed_as_is(*args: Any, **_: Any) -> FrozenGaussians:
    """The scene without a training step, as its own descent, so that its residual Gaussians count as present."""
    return dataclasses.replace(args[2], descent=args[2])


def _everywhere(*args: Any, **_: Any) -> list[Tensor]:
    """Ones for every plate of `(..., target, chosen, moved)`."""
    return [torch.ones_like(args[-3].depth) for _ in args[-2]]


def _freeze(module: str) -> Any:
    return importlib.import_module(f"torch_backend.freeze.{module}")


def _baseline(**numbers: Any) -> tuple[Switch, ...]:
    """Switches that preset the configuration of the static baseline's class with other numbers."""
    config = dataclasses.replace(StaticBaselineConfig(), **numbers)
    return (Switch(MAKER, "StaticBaseline", partial(partial, config=config), of_original=True),)


def _as_it_was(room: Any, *_: Any) -> dict[str, Tensor]:
    return dict(room.frozen.state)


def _no_residuals(original: Callable[..., Any]) -> Callable[..., Any]:
    def filled(source_views: Any, config: Any, target: Any, fillers: Any, *args: Any) -> Any:
        residuals = [torch.zeros_like(residual) for residual in fillers.residuals]
        return original(source_views, config, target, dataclasses.replace(fillers, residuals=residuals), *args)

    return filled


def _none_undersampled(*args: Any, **_: Any) -> Tensor:
    return torch.zeros(len(args[2]), dtype=torch.bool)


def _number(name: str, effect: str, **numbers: Any) -> Rule:
    return Rule(name, effect, numbers={path.replace("__", "."): value for path, value in numbers.items()})


_SCENE = (
    Rule(
        "static baseline", "nothing is closed", STAGES[0],
        (Switch(MAKER, STAGES[0], _third),),
    ),
    Rule(
        "baseline from near", "nothing counts as seen from near by the baseline", STAGES[0],
        _baseline(nearer=0.0),
    ),
    Rule("missing movers", "nothing is added", STAGES[1], (Switch(MAKER, STAGES[1], _third),)),
    Rule("develop", "no training step", "develop", (Switch(MAKER, "develop", _developed_as_is),)),
    Rule(
        "undersampled", "plate t* teaches what it sees from afar", "develop",
        (Switch("instant.develop", "undersampled", _none_undersampled),),
    ),
    Rule(
        "movers alone", "no second training of movers", "develop",
        (Switch("instant.develop", "_FineTuning._movers_only", _as_it_was),),
    ),
)  # fmt: skip
STATE = (
    _number("plate matte", "the plate's motion matte says nothing", state__weights__plate_matte=0.0),
    _number("scene flow", "the model's travel says nothing", state__weights__scene_flow=0.0),
    _number("change", "plate against frozen render says nothing", state__weights__change=0.0),
    _number("gain", "plate against its own time says nothing", state__weights__gain=0.0),
    _number("contradiction", "plate against plate t* says nothing", state__weights__contradiction=0.0),
    _number("smoothing", "log-odds as they are", state__smoothing=0.0),
    _number("softness", "hard borders", state__softness=0.01),
)
"""Terms that decide which pixels of the own plate are rejected."""
_FILL = (
    Rule(
        "agreed", "plates of other times need not agree with t*",
        switches=(Switch("composite.fill", "_agreed", _everywhere),),
    ),
    Rule(
        "rough", "single pixels of a plate count",
        switches=(Switch("composite.fill", "_visible_surroundings", _everywhere),),
    ),
    Rule(
        "plate t*'s pixels", "plate t* gives residuals alone",
        switches=(Switch("composite.fill", "_take_instant", _none),),
    ),
    _number("sway", "no other time where something moves", sway_trust=0.0),
    _number("depth error", "plates are believed whatever the baseline", depth_error=0.0),
    _number("doubt", "what plates say is believed wholly", doubt=0.0),
    Rule("residuals", "splats alone in the fill", switches=(Switch("composite.fill", "filled", _no_residuals, True),)),
)  # fmt: skip


def _scaled(value: Any, factor: float) -> Any:
    """A number, or each number of a tuple, times a factor; integers stay integers."""
    if isinstance(value, tuple):
        return tuple(_scaled(each, factor) for each in value)
    return round(value * factor) if isinstance(value, int) else value * factor


def _is_number(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_is_number(each) for each in value)
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(config: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yields (path, value) of every number of a configuration, including nested ones."""
    for each in dataclasses.fields(config):
        value, at = getattr(config, each.name), f"{path}{each.name}"
        if dataclasses.is_dataclass(value):
            yield from _numbers(value, f"{at}.")
        elif _is_number(value) and each.name not in NOT_SWEPT:
            yield at, value


def _swept() -> Iterator[Rule]:
    """Yields one rule per number, halved and doubled: numbers of frames, of the instant, and constants of modules."""
    for word, factor in SWEEP.items():
        for path, value in _numbers(CompositeConfig()):
            yield Rule(f"{word} {path}", f"times {factor}", numbers={path: _scaled(value, factor)})
        for path, value in _numbers(DevelopConfig()):
            change = partial(_changed, path, _scaled(value, factor))
            switch = Switch("instant.instants", "config_for", change, of_original=True)
            yield Rule(f"{word} develop.{path}", f"times {factor}", STAGES[2], (switch,))
        for path, value in _numbers(StaticBaselineConfig()):
            yield Rule(
                f"{word} baseline.{path}", f"times {factor}", STAGES[0], _baseline(**{path: _scaled(value, factor)})
            )
        for module, name, stage in CONSTANTS:
            switch = Switch(module, name, partial(_scaled, factor=factor), of_original=True)
            yield Rule(f"{word} {module.rsplit('.', 1)[-1]}.{name}", f"times {factor}", stage, (switch,))


def _changed(path: str, value: Any, config_for: Callable[..., Any]) -> Callable[..., Any]:
    return lambda run: dataclasses.replace(config_for(run), **{path: value})


SWEEP = {"half": 0.5, "twice": 2.0}
"""Word -> factor that multiplies every number, one number at a time (groups `sweep-scene` and `sweep-frame`)."""
NOT_SWEPT = ("seed",)
"""Fields that are not amounts."""
CONSTANTS = (
    ("views.source_views", "DOUBT", FRAME),
    ("views.decisions", "MARGIN", FRAME),
    ("views.working_plates", "SEEN", STAGES[2]),
)
"""(module, name, stage) of the constants that are swept."""

RULES = {rule.name: rule for rule in (*_SCENE, *STATE, *_FILL, *_swept())}
"""Name -> rule."""

COMBINATIONS = {
    "today": frozenset[str](),
    "mattes alone": frozenset(("scene flow", "change", "gain", "contradiction")),
    "motion alone": frozenset(("change", "gain", "contradiction")),
}
"""Name -> rules that are off. In `motion alone`, mattes and the model's scene flow decide the state."""


def variants(groups: tuple[str, ...]) -> dict[str, frozenset[str]]:
    """Name -> rules that are off, for `today` and for `groups`: combinations, scene, frame, sweep-scene, sweep-frame,
    or a variant's own name. The sweep groups halve and double every number. ValueError for an unknown group."""
    swept = {name: frozenset({name}) for name in RULES if name.split()[0] in SWEEP}
    every = {**COMBINATIONS, **{f"no {name}": frozenset({name}) for name in RULES if name not in swept}, **swept}
    found = {"today": every["today"]}
    for group in groups:
        if group == "combinations":
            found |= COMBINATIONS
        elif group in ("sweep-scene", f"sweep-{FRAME}"):
            found |= {
                name: disabled for name, disabled in swept.items() if bool(of_frames(disabled)) == group.endswith(FRAME)
            }
        elif group in ("scene", FRAME):
            of = {name for name, rule in RULES.items() if (rule.stage == FRAME) == (group == FRAME)}
            found |= {name: disabled for name, disabled in every.items() if name.startswith("no ") and disabled <= of}
        elif group in every:
            found[group] = every[group]
        else:
            raise ValueError(f"there is no group or variant {group!r}: it should be one of {', '.join(every)}")
    return found


def of_frames(disabled: frozenset[str]) -> frozenset[str]:
    """The rules that affect frames."""
    return frozenset(name for name in disabled if RULES[name].stage == FRAME)


def of_stage(disabled: frozenset[str], stage: str) -> frozenset[str]:
    """The rules that act in a stage."""
    return frozenset(name for name in disabled if RULES[name].stage == stage)


def detail_config(disabled: frozenset[str]) -> CompositeConfig:
    """The compositing configuration with the numbers of rules `disabled` set to neutral values."""
    config = CompositeConfig()
    for name in sorted(disabled):
        for path, value in RULES[name].numbers.items():
            config = _with(config, path.split("."), value)
    return config


def _with(config: Any, path: list[str], value: Any) -> Any:
    """A dataclass with the field at the end of a path replaced."""
    name, *inner = path
    return dataclasses.replace(config, **{name: _with(getattr(config, name), inner, value) if inner else value})


@contextlib.contextmanager
def rules_disabled(disabled: frozenset[str]) -> Iterator[None]:
    """Context in which the names of rules are replaced. KeyError for an unknown rule."""
    switches = [switch for name in sorted(disabled) for switch in RULES[name].switches]
    with contextlib.ExitStack() as stack:
        for switch in switches:
            stack.enter_context(replaced(switch.module, switch.name, partial(_instead, switch)))
        yield


def _instead(switch: Switch, original: Callable[..., Any]) -> Callable[..., Any]:
    return switch.neutral(original) if switch.of_original else switch.neutral


@contextlib.contextmanager
def replaced(module: str, name: str, by: Callable[[Callable[..., Any]], Callable[..., Any]]) -> Iterator[None]:
    """Context in which `by(original)` replaces a name of a freeze module. AttributeError for an unknown name."""
    holder = _freeze(module)
    *classes, name = name.split(".")
    for each in classes:
        holder = getattr(holder, each)
    before = getattr(holder, name)
    setattr(holder, name, by(before))
    try:
        yield
    finally:
        setattr(holder, name, before)
