"""The freeze's rules and terms, each with what stands in its place when it is off.

The freeze has no switches of its own. A rule is switched off in this process alone: a name of a module gets a neutral
replacement, or a field of `DetailConfig` a neutral value. This is the only file of the bench that knows the freeze's
insides; when the freeze becomes a list of named repairs and terms, `RULES` is read from that list. A rule whose names
the freeze does not have any more is left out of `RULES`, and of combinations.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_backend.freeze.composite.config import DetailConfig
from torch_backend.freeze.frozen import FrozenGaussians

FRAME = "frame"
"""Stage of the rules that decide each frame; all other stages make the instant."""
STAGES = ("turned", "settled", "without_specks", "adrift", "instant_layer", "with_unseen", "develop")
"""Names in `torch_backend.freeze.developed_instants` of the steps that make an instant, in their order."""
_MAKER = "developed_instants"
_NEVER = 1e9
"""Above every threshold that is compared with a difference, a share or a length in pixels."""


@dataclass(frozen=True)
class Switch:
    """One name that is replaced while a rule is off."""

    module: str
    """Module of `torch_backend.freeze`."""
    name: str
    """Name in it, with a dot for a method of a class."""
    neutral: Callable[..., Any]
    """What stands there instead."""
    of_original: bool = False
    """True if `neutral` is called with what stands there, and returns what stands there instead."""


@dataclass(frozen=True)
class Rule:
    """One rule or term of the freeze."""

    name: str
    """Short name, as in the table."""
    off: str
    """What happens when it is off."""
    stage: str = FRAME
    """Step that it acts in: one of `STAGES`, or `FRAME`."""
    switches: tuple[Switch, ...] = ()
    """Names that are replaced."""
    numbers: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Fields of `DetailConfig` with their neutral values."""


# ---------------------------------------------------------------------------------------------- neutral replacements


def _none(*_: Any, **__: Any) -> None:
    """Nothing was found."""


def _third(*args: Any, **_: Any) -> Any:
    """The frozen scene of `(run, scene, frozen, ...)`, unchanged."""
    return args[2]


def _developed_as_is(*args: Any, **_: Any) -> FrozenGaussians:
    """The scene without a training step; its descent says that it has its layer already."""
    return dataclasses.replace(args[2], descent=args[2])


def _first(*args: Any, **_: Any) -> Any:
    """The first argument, unchanged."""
    return args[0]


def _nowhere(at: int) -> Callable[..., Tensor]:
    """A mask of zeros, of the size of the argument in place `at` or of its depth."""

    def zeros(*args: Any, **_: Any) -> Tensor:
        like = getattr(args[at], "depth", args[at])
        return torch.zeros(like.shape[:2])

    return zeros


def _everywhere(*args: Any, **_: Any) -> list[Tensor]:
    """Ones for every plate of `(sightings, config, posed, chosen, moved)`."""
    return [torch.ones_like(args[2].depth) for _ in args[3]]


def _no_rows(*_: Any, **__: Any) -> Tensor:
    return torch.zeros(0, dtype=torch.int64)


def _no_veils(*_: Any, **__: Any) -> tuple[Tensor, Tensor]:
    return torch.zeros(0, dtype=torch.int64), torch.zeros(0)


def _not_contradicted(bench: Any, *_: Any, **__: Any) -> Any:
    return np.zeros((bench.height, bench.width), bool)


def _not_torn(bench: Any, *_: Any, **__: Any) -> Any:
    nothing = np.zeros((bench.height, bench.width), np.float32)
    return _freeze("torn").Torn(_not_contradicted(bench), nothing)


def _freeze(module: str) -> Any:
    return importlib.import_module(f"torch_backend.freeze.{module}")


def _never_near(config: Any) -> Any:
    """`TwinConfig` with which no plate sees anything from near."""
    return partial(config, nearer=0.0)


def _never_misplaced(config: Any) -> Any:
    """`InstantConfig` with which nothing hangs on anything surely enough to contradict the field."""
    return partial(config, depth=_freeze("instant_depth").DepthConfig(surely=2.0))


def _no_layer_ghosts(bench: Any, frozen: FrozenGaussians, *_: Any) -> tuple[Tensor, Any]:
    return torch.ones(len(frozen.motion)), _not_contradicted(bench)


def _as_it_was(room: Any, *_: Any) -> dict[str, Tensor]:
    return dict(room.frozen.state)


def _no_holes(wrong: Tensor, found: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return wrong.float(), found.float()


def _no_residual(_: Tensor, places: Tensor) -> Tensor:
    return torch.zeros(*places.shape[:-1], 3)


def _none_afar(*args: Any, **_: Any) -> Tensor:
    return torch.zeros(len(args[2]), dtype=torch.bool)


def _unbridged(places: Tensor, seen: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return places, seen


def _in_layer(name: str, off: str, *switches: Switch) -> Rule:
    return Rule(name, off, "instant_layer", switches)


_SCENE = (
    Rule("turned", "no change points", "turned", (Switch(_MAKER, "turned", _none),)),
    Rule("static twin", "nothing is closed", "settled", (Switch(_MAKER, "settled", _third),)),
    Rule(
        "twin from afar", "nothing counts as seen from near by the twin", "settled",
        (Switch("static_twin", "TwinConfig", _never_near, of_original=True),),
    ),
    Rule("specks", "specks stay", "without_specks", (Switch(_MAKER, "without_specks", _third),)),
    Rule("adrift", "islands stay", "adrift", (Switch(_MAKER, "adrift", _none),)),
    Rule("layer", "no missing layer", "instant_layer", (Switch(_MAKER, "instant_layer", _none),)),
    _in_layer("contradicted", "no photometric check", Switch("missing_layer", "contradicted", _not_contradicted)),
    _in_layer("torn", "nothing has fallen apart", Switch("missing_layer", "torn", _not_torn)),
    _in_layer(
        "misplaced", "the field's depth is believed",
        Switch("missing_layer", "InstantConfig", _never_misplaced, of_original=True),
        Switch("unseen", "InstantConfig", _never_misplaced, of_original=True),
    ),
    _in_layer("veils", "veils stay", Switch("instant_bench", "InstantBench.veils", _no_veils)),
    _in_layer("crumbs", "crumbs stay", Switch("missing_layer", "_crumbs", _no_rows)),
    _in_layer("layer's ghosts", "no Gaussian is faded", Switch("missing_layer", "_ghosts", _no_layer_ghosts)),
    _in_layer(
        "small things", "none is followed", Switch("missing_layer", "small_things", lambda *_: []),
        Switch("unseen", "small_things", lambda *_: []),
    ),
    _in_layer("swing", "no swing is fitted", Switch("missing_layer", "swing", _none)),
    _in_layer("logo check", "no region is a logo", Switch("missing_layer", "_stuck", lambda *_: False)),
    Rule("unseen", "nothing from other plates", "with_unseen", (Switch(_MAKER, "with_unseen", _third),)),
    Rule("develop", "no training step", "develop", (Switch(_MAKER, "develop", _developed_as_is),)),
    Rule(
        "from afar", "plate t* teaches what it sees from afar", "develop",
        (Switch("develop", "seen_from_afar", _none_afar),),
    ),
    Rule(
        "movers alone", "no second training of movers", "develop",
        (Switch("develop", "_Darkroom._movers_alone", _as_it_was),),
    ),
)  # fmt: skip


def _term(name: str, off: str, module: str, function: str, neutral: Callable[..., Any]) -> Rule:
    return Rule(name, off, switches=(Switch(module, function, neutral),))


def _number(name: str, off: str, **numbers: Any) -> Rule:
    return Rule(name, off, numbers=numbers)


OWN_PLATE = (
    _term("travel", "the model's travel lets go of nothing", "leading_plate", "_swayed", _nowhere(2)),
    _term("beside", "neighbouring plates' mattes are not asked", "leading_plate", "_beside", _nowhere(2)),
    _term("of its time", "no own-time evidence", "leading_plate", "_of_its_time", _nowhere(3)),
    _number("own time", "no growth along own-time differences", own_time=_NEVER),
    _number("carried", "no growth along the model's travel", carried=_NEVER),
    _term("denied", "plate t* denies nothing", "leading_plate", "_denied", _nowhere(3)),
    _number("denied too", "no growth along what plate t* contradicts", denied_too=_NEVER),
    _number("beyond", "no growth where plate t* does not see", beyond=1e12),
    _term("held", "nothing is held", "leading_plate", "held", _nowhere(2)),
    _term("holes", "holes stay", "leading_plate", "with_holes", _no_holes),
    _number("gap", "gaps stay, here and in plate t*'s pixels", gap=0),
    _term("otherwise", "change points let go of nothing", "leading_plate", "_otherwise", _none),
    _term("added share", "recovered objects count as the run's own", "leading_plate", "added_share", _none),
    _number("margin", "no margin around what is let go of", margin=0),
    _number("feather", "hard borders", feather=0.0),
)
"""Rules that decide where the frame's own plate is let go of."""
_FILL = (
    _term("plate t*'s pixels", "plate t* gives residuals alone", "fill", "instant_pixels", _none),
    _term("ghosts", "plate t* does not cover ghosts", "instant_pixels", "ghosts", _none),
    _term("torn pixels", "no regions where splats fell apart", "instant_pixels", "_torn", _nowhere(2)),
    _term("plain pixels", "none in plain view of plate t*", "instant_pixels", "_plain", _nowhere(2)),
    _term("returns", "no round trip to plate t*", "instant_view", "_returns", _nowhere(3)),
    Rule(
        "bridged", "gaps of plate t* stay",
        switches=(Switch("instant_pixels", "bridged", _unbridged), Switch("ghosts", "bridged", _unbridged)),
    ),
    _number("angle", "plate t* from any side", beside=(179.0, 180.0)),
    _number("coarser", "plate t* from any distance", coarser=(_NEVER, 2.0 * _NEVER)),
    _number("medians", "depth as rendered", medians=0),
    _term("agreed", "plates of other times need not agree with t*", "fill", "_agreed", _everywhere),
    _term("rough", "single pixels of a plate count", "fill", "_shown", _everywhere),
    _number("sway", "no other time where something moves", sway_trust=0.0),
    _number("depth error", "plates are believed whatever the baseline", depth_error=0.0),
    _number("doubt", "what plates say is believed wholly", doubt=0.0),
    _term("residuals", "splats alone in the fill", "fill", "look_up_near", _no_residual),
)  # fmt: skip


def _is_there(rule: Rule) -> bool:
    """True if the freeze has every name and number of a rule."""
    fields = {field.name for field in dataclasses.fields(DetailConfig)}
    return set(rule.numbers) <= fields and all(_found(switch) is not None for switch in rule.switches)


def _found(switch: Switch) -> Any:
    """What a switch replaces; None if it is not there."""
    try:
        found = _freeze(switch.module)
    except ModuleNotFoundError:
        return None
    for name in switch.name.split("."):
        found = getattr(found, name, None)
    return found


RULES = {rule.name: rule for rule in (*_SCENE, *OWN_PLATE, *_FILL) if _is_there(rule)}
"""Name -> rule."""

_BARE_SCENE = ("turned", "specks", "adrift", "layer", "unseen")
_BARE_OWN = (
    "beside", "of its time", "own time", "carried", "denied", "denied too", "beyond", "held", "holes", "gap",
    "otherwise",
)  # fmt: skip
_NULL = frozenset((*_BARE_SCENE, *_BARE_OWN, "plate t*'s pixels"))
_P = _NULL - {"held", "gap", "plate t*'s pixels"} | {"ghosts"}
_COMBINATIONS = {
    "today": frozenset[str](),
    "null": _NULL,
    "P": _P,
    "P + ghosts": _P - {"ghosts"},
    "P + holes": _P - {"holes"},
    "P + of its time": _P - {"of its time"},
    "P + beside": _P - {"beside"},
    "P + denied": _P - {"denied"},
    "null's decisions": _NULL - set(_BARE_SCENE),
    "P's decisions": _P - set(_BARE_SCENE),
    "null + held": _NULL - {"held"},
    "null + plate t*'s pixels": _NULL - {"plate t*'s pixels"},
}
COMBINATIONS = {name: off.intersection(RULES) for name, off in _COMBINATIONS.items()}
"""Name -> rules that are off.

`null`: the own plate is let go of by motion mattes and the model's travel alone, on the scene with static twin and
develop; no plate t*'s pixels. `P`: `null` with `held`, its closing of gaps, and plate t*'s pixels for what moves.
"Decisions" are those of frames alone, on today's scene.
"""


def variants(groups: tuple[str, ...]) -> dict[str, frozenset[str]]:
    """Name -> rules that are off, of `today` and of `groups`: combinations, scene, frame, or a variant's own name."""
    every = {**COMBINATIONS, **{f"no {name}": frozenset({name}) for name in RULES}}
    found = {"today": every["today"]}
    for group in groups:
        if group == "combinations":
            found |= COMBINATIONS
        elif group in ("scene", FRAME):
            of = {name for name, rule in RULES.items() if (rule.stage == FRAME) == (group == FRAME)}
            found |= {name: off for name, off in every.items() if name.startswith("no ") and off <= of}
        elif group in every:
            found[group] = every[group]
        else:
            raise ValueError(f"there is no group or variant {group!r}: it should be one of {', '.join(every)}")
    return found


def of_frames(off: frozenset[str]) -> frozenset[str]:
    """Of rules those that decide frames."""
    return frozenset(name for name in off if RULES[name].stage == FRAME)


def of_stage(off: frozenset[str], stage: str) -> frozenset[str]:
    """Of rules those that act in a stage. What makes a layer is shared by three of them."""
    shared = ("adrift", "instant_layer", "with_unseen")
    return frozenset(name for name in off if RULES[name].stage in (shared if stage in shared else (stage,)))


def detail_config(off: frozenset[str]) -> DetailConfig:
    """The configuration of plate detail with the numbers of rules neutral."""
    numbers: dict[str, Any] = {}
    for name in sorted(off):
        numbers |= RULES[name].numbers
    return dataclasses.replace(DetailConfig(), **numbers)


@contextlib.contextmanager
def switched_off(off: frozenset[str]) -> Iterator[None]:
    """While this lasts the names of rules are replaced. KeyError for a rule that there is not."""
    switches = [switch for name in sorted(off) for switch in RULES[name].switches]
    with contextlib.ExitStack() as stack:
        for switch in switches:
            stack.enter_context(replaced(switch.module, switch.name, partial(_instead, switch)))
        yield


def _instead(switch: Switch, original: Callable[..., Any]) -> Callable[..., Any]:
    return switch.neutral(original) if switch.of_original else switch.neutral


@contextlib.contextmanager
def replaced(module: str, name: str, by: Callable[[Callable[..., Any]], Callable[..., Any]]) -> Iterator[None]:
    """While this lasts a name of a module of the freeze is what `by` makes of it. AttributeError if it is not there."""
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
