"""The add-on in other languages: one file per locale, English sentence -> sentence.

Sentences are composed, kept and logged in English, here and in the backend's process. They are translated where they
are shown, when their values are no longer known: `tr` therefore gets a whole sentence, not a template with values.
Blender itself translates labels of buttons and tooltips. `{}` in a key stands for any value: "74 frames, 1 to 74" is
found under "{} frames, {} to {}". In the translation `{}` is the next value, `{1}` the second, `{!t}` a value that is
itself translated, and `{!l}` a list of such values.

tests/addon/test_translations.py prints the lines that a language lacks.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping

import bpy

from . import de_DE

LANGUAGES: dict[str, Mapping[str, str]] = {"de_DE": de_DE.MESSAGES}
"""Locale, as Blender names it -> English sentence -> sentence."""

_PACKAGE = __name__.partition(".splannequin_addon")[0]
_CONTEXTS = ("*", "Operator")
"""Where Blender looks: what buttons of operators say has a context of its own."""
_FIELD = re.compile(r"\{(\d*)(![tl])?\}")


def tr(text: str) -> str:
    """A composed sentence (or several) in the language of the interface; as it is where there is no translation."""
    if not bpy.context.preferences.view.use_translate_interface:
        return text
    return translate(text, bpy.app.translations.locale)


def translate(text: str, locale: str) -> str:
    """`text` in a language; sentences that it does not have stay as they are."""
    if locale not in LANGUAGES or not text:
        return text
    return _known(text, locale) or " ".join(_known(part, locale) or part for part in _sentences(text))


@functools.lru_cache(maxsize=1024)
def _known(text: str, locale: str) -> str | None:
    """The translation of what is known in full, else None."""
    exact = LANGUAGES[locale].get(text)
    if exact is not None:
        return exact
    # Two sentences before one with a field that would swallow the second.
    parts = _sentences(text)
    for cut in range(1, len(parts)):
        first, rest = _known(" ".join(parts[:cut]), locale), _known(" ".join(parts[cut:]), locale)
        if first is not None and rest is not None:
            return f"{first} {rest}"
    for pattern, target in _patterns(locale):
        found = pattern.fullmatch(text)
        if found:
            return _filled(target, found.groups(), locale)
    return None


def _sentences(text: str) -> list[str]:
    return re.split(r"(?<=\.) ", text)


def _filled(target: str, values: tuple[str, ...], locale: str) -> str:
    """Puts values into the fields of a translation."""
    following = iter(values)

    def value(field: re.Match[str]) -> str:
        value = values[int(field[1])] if field[1] else next(following)
        if field[2] == "!l":
            return ", ".join(translate(part, locale) for part in value.split(", "))
        return translate(value, locale) if field[2] else value

    return _FIELD.sub(value, target)


@functools.cache
def _patterns(locale: str) -> list[tuple[re.Pattern[str], str]]:
    """(what composed sentences look like, their translation): those that begin with a word, then the longest first."""
    composed = [(key, target) for key, target in LANGUAGES[locale].items() if "{}" in key]
    composed.sort(key=lambda pair: (pair[0].startswith("{}"), -len(pair[0].replace("{}", ""))))
    return [
        (re.compile("(.*?)".join(re.escape(part) for part in key.split("{}")), re.DOTALL), target)
        for key, target in composed
    ]


def register() -> None:
    """Makes the translations known to Blender."""
    sentences = {
        locale: {(context, key): target for key, target in messages.items() for context in _CONTEXTS}
        for locale, messages in LANGUAGES.items()
    }
    bpy.app.translations.register(_PACKAGE, sentences)


def unregister() -> None:
    """Takes them back."""
    bpy.app.translations.unregister(_PACKAGE)
