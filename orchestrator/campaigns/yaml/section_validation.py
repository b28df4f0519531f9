"""Validates plain data with places into settings, and reports pydantic's errors as problems with their places.

`validate` finds as many problems as possible in one pass: invalid values, missing keys, and the problems that
`Settings.check_values` finds between keys. `PlacedProblems` places the latter.
"""

from __future__ import annotations

import copy
import difflib
import typing
from collections.abc import Iterator
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from orchestrator.campaigns.search_ranges import EXAMPLES
from orchestrator.campaigns.yaml.yaml_source import Loc, Place, Report
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.errors import did_you_mean
from sim_engine.settings.model import OneOf, Problems, Settings
from sim_engine.settings.plugin_registry import why_unusable
from sim_engine.settings.quantity import FROM_FILE

S = TypeVar("S", bound=Settings)


def validate(model: type[S], place: Place, report: Report) -> S | None:
    """The settings at a place; all problems are added to the report.

    Invalid parts are removed and the rest is validated again. The result thus has all valid parts, which later checks
    can use. It is None only if nothing is left. After a problem it is a draft: required keys may be None.
    """
    document = place.document
    if place.loc == ():
        report.problems.extend(document.problems)
    data = copy.deepcopy(document.get(place.loc))
    if not isinstance(data, dict):
        report.add(
            place,
            f"should be a mapping with keys such as {', '.join(list(model.written_keys())[:3])}, got {_name(data)}",
        )
        return None
    _cut_empty(data, place, report)
    guessed: set[Loc] = set()
    while True:
        try:
            section = model.model_validate(data, context=FROM_FILE)
        except ValidationError as error:
            # Deepest first and last items first, so that a removal does not move the others.
            details = sorted(
                error.errors(include_url=False), key=lambda e: (len(e["loc"]), str(e["loc"])), reverse=True
            )
            locs = [_loc_in(data, detail["loc"]) for detail in details]
            cut = False
            for detail, loc in zip(details, locs, strict=True):
                if detail["type"] == "union_tag_invalid" and isinstance(detail["input"], dict):
                    _guess_variant(_sections_at(model, loc, data), detail["input"], place.at(*loc), report)
                    guessed.add(loc)
                    cut = True
                    continue
                unknown = detail["type"] == "extra_forbidden"
                if unknown and (owners := _owners(model, loc, data)):
                    if loc[:-1] not in guessed:
                        variants = _variant(_sections_at(model, loc[:-1], data), _node(data, loc[:-1]))
                        names = " and ".join(sorted({owner.tag_word() for owner in owners}))
                        text = f"belongs to {names}, not to {' or '.join(v.tag_word() for v in variants)}; remove it"
                        report.add(place.at(*loc), text, key=True)
                else:
                    report.add(place.at(*loc), _message(model, detail, loc, data), key=unknown)
                    if unknown and (meant := _meant(model, loc, data)) is not None:
                        # the key is not reported as missing as well
                        report.broken.add((place.document.path, place.at(*loc[:-1], meant).loc))
                cut = _cut(data, loc) or cut
            if not cut:
                return None
            continue
        _note_missing(section, place, report)
        _check_values(section, place, report)
        return section


def _guess_variant(variants: set[type[Settings]], data: dict[str, Any], place: Place, report: Report) -> None:
    """Report that the key that selects the variant is missing or wrong; continue with the best-matching variant."""
    key, word = next(iter(variants)).tag, data.get(next(iter(variants)).tag)
    words = sorted(section.tag_word() for section in variants)
    if word in words:
        raise RuntimeError(f"the kind '{word}' was registered after the first {place} had been validated")
    if word is None:
        examples = [keys[key] for section in variants if key in (keys := section.required_keys())]
        text = f"key '{key}' is missing; add for example '{key}: {max(examples)}'"
        report.add(place, text, key=True)
        report.broken.add((place.document.path, place.at(key).loc))
    else:
        expected = " or ".join([", ".join(map(repr, words[:-1])), repr(words[-1])])
        reason = why_unusable(next(iter(variants)).plugins, word) if isinstance(word, str) else ""
        report.add(place.at(key), reason or _one_of(word, expected))
    by_word = {section.tag_word(): section for section in variants}

    def fits(name: str) -> tuple[int, float]:
        alike = difflib.SequenceMatcher(None, str(word), name).ratio()
        return len(data.keys() & by_word[name].written_keys()), alike

    data[key] = max(words, key=fits)


def _variant(sections: set[type[Settings]], data: Any) -> set[type[Settings]]:
    """The sections that the data are meant to be, among those that are possible at their place."""
    if not isinstance(data, dict):
        return sections
    return {
        section
        for section in sections
        if not section.tag or section.tag_word() == data.get(section.tag, section.default_tag)
    }


def _owners(model: type[Settings], loc: Loc, data: Any) -> set[type[Settings]]:
    """The variants that have a key which the selected variant lacks."""
    variants = {section for section in _sections_at(model, loc[:-1], data) if section.tag}
    if not variants and len(loc) > 1 and any(section.variant for section in _sections_at(model, loc[:-1], data)):
        for parent in _sections_at(model, loc[:-2], data):
            variants |= {s for info in parent.model_fields.values() for s in sections_in(info.annotation) if s.variant}
    return {section for section in variants if loc[-1] in section.written_keys()}


def _node(data: Any, loc: Loc) -> Any:
    for key in loc:
        data = data[key]
    return data


def _cut(data: Any, loc: Loc) -> bool:
    """Remove a location from the data; False if that is everything, or it was removed already."""
    # Removing an item of a list would change the meaning of its neighbours, so the whole list is removed.
    target = loc
    while target and isinstance(target[-1], int):
        target = target[:-1]
    if not target or _loc_in(data, target) != target:
        return False
    node = data
    for key in target[:-1]:
        node = node[key]
    del node[target[-1]]
    return True


def _loc_in(data: Any, loc: Loc) -> Loc:
    """The location without union tags and filled-in keys, which the file does not have."""
    path: list[str | int] = []
    for key in loc:
        in_mapping = isinstance(data, dict) and key in data
        in_list = isinstance(data, list) and isinstance(key, int) and key < len(data)
        if in_mapping or in_list:
            data = data[key]
            path.append(key)
    return tuple(path)


def _cut_empty(data: Any, place: Place, report: Report) -> None:
    if isinstance(data, dict):
        for key in [key for key, value in data.items() if value is None]:
            report.add(place.at(key), "has no value; give one, or remove the key", key=True)
            del data[key]
        for key, value in data.items():
            _cut_empty(value, place.at(key), report)
    elif isinstance(data, list):
        for i, value in enumerate(data):
            _cut_empty(value, place.at(i), report)


def _note_missing(section: Settings, place: Place, report: Report) -> None:
    for key, example in section.required_keys().items():
        if section.value(key) is None and not report.is_broken_within(place.at(key)):
            shown = f"{key}: {example}"
            report.add(place, f"key '{key}' is missing; add for example '{shown}'", key=True)
            report.broken.add((place.document.path, place.at(key).loc))
    for inner, at in _inside(section, place):
        _note_missing(inner, at, report)


def _check_values(section: Settings, place: Place, report: Report) -> None:
    """Apply the rules between keys, those of inner settings first."""
    for inner, at in _inside(section, place):
        _check_values(inner, at, report)
    section.check_values(PlacedProblems(place, report))


def _inside(section: Settings, place: Place) -> Iterator[tuple[Settings, Place]]:
    """The settings in other settings that are written in the same file."""
    for key in section.written_keys():
        value = section.value(key)
        if isinstance(value, Settings) and place.at(key).loc in place.document.marks:
            yield value, place.at(key)
        elif isinstance(value, list | tuple):
            yield from ((item, place.at(key, i)) for i, item in enumerate(value) if isinstance(item, Settings))


def _message(model: type[Settings], detail: ErrorDetails, loc: Loc, data: Any) -> str:
    context = detail.get("ctx", {})
    value = detail["input"]
    match detail["type"]:
        case "extra_forbidden":
            return _unknown_key(model, loc, data)
        case "literal_error":
            return _one_of(value, str(context["expected"]))
        case "string_pattern_mismatch":
            return f"{value!r} should consist of letters, digits, '.', '_' and '-' and begin with a letter or digit"
        case "string_type":
            return f"should be text, got {_name(value)}; put it in quotes if it is meant"
        case "string_too_short":
            return "is empty"
        case "int_type":
            return f"should be a whole number, got {_name(value)}"
        case "float_type":
            return f"should be a number, got {_name(value)}"
        case "bool_type":
            return f"should be true or false, got {_name(value)}"
        case "greater_than_equal":
            return f"{value} is too small; at least {_bound(context['ge'])}"
        case "finite_number":
            return f"should be a finite number, got {value}"
        case "string_too_long":
            return f"has {len(str(value))} characters; at most {context['max_length']}"
        case "less_than_equal":
            return f"{value} is too large; at most {_bound(context['le'])}"
        case "list_type" | "tuple_type":
            return f"should be a list [...], got {_name(value)}"
        case "model_type" | "model_attributes_type" | "dict_type" | "union_tag_invalid":
            return f"should be a mapping (key: value), got {_name(value)}"
        case "missing":
            return "has too few items; should be [r, z]" if loc and isinstance(loc[-1], int) else "is missing"
        case "too_short":
            return "is empty; name at least one, or remove the key"
        case "too_long":
            return f"has {context['actual_length']} items; should have {context['max_length']}"
        case _:
            return str(detail["msg"])


def _bound(number: float) -> str:
    return f"{number:,}" if isinstance(number, int) and number >= 10_000 else f"{number:g}"


REMOVED = {
    "object_store": "a private Ray reserves 160 MB; remove it",
    "smallest_top_up": "this limit of doses is fixed; remove it",
    "on_failed_pour": "a pour that fails while it is made counts as the worst loss; remove it",
    "discrepancy_policy": "a simulator that seems wrong is weighted accordingly and reported; remove it",
    "pareto": "a deployment has one 'objective'; remove it",
    "objectives": "weighted sums are gone; give one, as 'objective: {name: target_volume, volume: 150 mL}'",
    "floor": "it is a key of the objective: 'objective: {name: spilled, floor: 0.5}'",
    "risk": "planning under errors of execution is gone; remove it, and 'decant simulate' predicts deviations",
    "trust": "'model: residual' always believes the simulator, and 'model: adaptive' weighs it by the pours; remove it",
    "ignorance": "a simulator that seems wrong is weighted accordingly and reported; remove it",
    "window": "'decant simulate' predicts deviations from an action; remove it",
    "prices": "simulations run while the arm pours, 'simulations_per_pour' of them; remove it",
    "costs": "simulations run while the arm pours, 'simulations_per_pour' of them; remove it",
}
"""Remedies for keys of earlier versions."""

RENAMED = {
    "announcement": "warning_time",
    "dynamic_viscosity": "viscosity",
    "gain_below": "min_gain",
    "hold_cap": "max_hold_time",
    "initial": "initial_samples",
    "lip_drop": "rim_correction",
    "otherwise": "fallback",
    "per_axis": "points_per_axis",
    "per_pour": "simulations_per_pour",
    "rrd": "recording",
    "untilt_speed": "upright_speed",
    "viscosity": "xsph_rate",
}
"""Keys of version 0.2 and their names since 0.3, which are not the most similar ones."""


def _unknown_key(model: type[Settings], loc: Loc, data: Any) -> str:
    key = str(loc[-1])
    if key in REMOVED:
        return f"unknown key; {REMOVED[key]}"
    keys = _keys(_sections_at(model, loc[:-1], data))
    if RENAMED.get(key) in keys:
        return f"unknown key; it is '{RENAMED[key]}' now"
    guess = _meant(model, loc, data)
    if guess is not None:
        return f"unknown key; did you mean '{guess}'?"
    if key in ACTION_DIMENSIONS:
        return f"unknown key here; fix it under 'motion: {{{key}: {EXAMPLES[key]}}}' or search it under 'actions'"
    if key in EXAMPLES:
        return f"unknown key here; it belongs under 'simulator: {{parameters: {{{key}: {EXAMPLES[key]}}}}}'"
    keys = _keys(_variant(_sections_at(model, loc[:-1], data), _node(data, loc[:-1])))
    return f"unknown key; known here: {', '.join(sorted(keys))}"


def _keys(sections: set[type[Settings]]) -> set[str]:
    return {name for section in sections for name in section.written_keys()}


def _meant(model: type[Settings], loc: Loc, data: Any) -> str | None:
    """The key most similar to a misspelt one: of the selected variant, or of another one."""
    variants = _sections_at(model, loc[:-1], data)
    keys = _keys(_variant(variants, _node(data, loc[:-1])))
    return did_you_mean(str(loc[-1]), keys) or did_you_mean(str(loc[-1]), _keys(variants))


def _sections_at(model: type[Settings], loc: Loc, data: Any) -> set[type[Settings]]:
    """The sections that are possible at a location of the data (several for a union)."""
    candidates: set[type[Settings]] = {model}
    for key in loc:
        if not isinstance(key, int):
            below: set[type[Settings]] = set()
            for candidate in _variant(candidates, data):
                if key in candidate.written_keys():
                    below |= sections_in(candidate.model_fields[candidate.written_keys()[key]].annotation)
            candidates = below
        data = data[key]
    return candidates


def sections_in(annotation: Any) -> set[type[Settings]]:
    """The sections that a field may hold: of those with variants, only the variants."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation} if issubclass(annotation, Settings) else set()
    if isinstance(annotation, OneOf):
        return set(annotation.kinds().values())
    sections = {section for argument in typing.get_args(annotation) for section in sections_in(argument)}
    return {section for section in sections if not section.tag or section.tag_word()}


def _one_of(value: Any, expected: str) -> str:
    words = [word.strip("' ") for word in expected.replace(" or ", ", ").split(",")]
    guess = did_you_mean(str(value), words)
    hint = f"did you mean '{guess}'?" if guess else f"should be {expected}"
    if value == "spillage" and guess == "spilled":  # the name that this objective had before
        hint = "spillage is spilled / poured, and this objective is spilled / loaded: write 'spilled'"
    return f"{value!r} is not known here; {hint}" if isinstance(value, str) else f"should be {expected}"


def _name(value: Any) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case None:
            return "nothing"
        case dict():
            return "a mapping"
        case list():
            return "a list"
        case str():
            return f"the text {value!r}" if len(value) < 40 else "a text"
        case _:
            return f"the number {value}"


class PlacedProblems:
    """See `sim_engine.settings.model.Problems`.

    Args:
        place: place of the settings.
        common: keys of the settings that `any` ignores.
    """

    def __init__(self, place: Place, report: Report, common: frozenset[str] = frozenset()) -> None:
        self._place, self._report, self._common = place, report, common
        self._before = len(report.problems)

    def add(self, text: str, *at: str | int, key: bool = False, of: str = "", more: bool = False) -> None:
        """See `Problems.add`."""
        if (at and not more and self._report.is_broken_within(self._place.at(*at))) or (of and not self.valid(of)):
            return
        self._report.add(self._place.at(*at), text, key=key)

    @property
    def any(self) -> bool:
        """See `Problems.any`."""
        if len(self._report.problems) > self._before:
            return True
        path, base, start = self._place.document.path, self._place.loc, len(self._place.loc)
        return any(
            where == path and loc[:start] == base and len(loc) > start and loc[start] not in self._common
            for where, loc in self._report.broken
        )

    def valid(self, *keys: str) -> bool:
        """See `Problems.valid`."""
        return not any(self._report.is_broken_within(self._place.at(key)) for key in keys)

    def within(self, *at: str | int) -> Problems:
        """See `Problems.within`."""
        return PlacedProblems(self._place.at(*at), self._report)
