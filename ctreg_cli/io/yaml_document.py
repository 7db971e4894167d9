"""YAML read strictly: every mistake with its place, no surprise types, no way to blow up.

PyYAML turns ``no`` into False, ``012`` into ten, ``1e-3`` into text, and lets the last of two equal keys win. So only
its node tree is used here: a scalar stays text until the schema says what it should be (an ``id: no`` is the text
"no", a ``diameter: 1e-3`` is a number), and every node remembers where it was written. Anchors, aliases and tags are
refused: such a file needs none, and nested aliases grow exponentially.
"""

from __future__ import annotations

import difflib
import hashlib
import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from ctreg_cli.errors import InputError

#: far above any real file (a frame of 500 rods has 40 kB), and read in a second or two
MAX_BYTES = 256 * 1024
MAX_DEPTH = 16
MAX_MISTAKES_SHOWN = 50
#: how the ``schema`` of every file of ours begins: ctreg/<kind>/<version>
FAMILY = "ctreg/"

KeyPath = tuple[str | int, ...]
Place = tuple[int, int]
#: where a value stands in the document, and what is wrong with it
Mistake = tuple[KeyPath, str]
_Located = tuple[Place, KeyPath, str]
Schema = TypeVar("Schema", bound="StrictSchema")

_DECIMAL = re.compile(r"[-+]?(0|[1-9]\d*)?(\.\d*)?([eE][-+]?\d+)?")
_LEADING_ZERO = re.compile(r"[-+]?0\d")
_NOT_FINITE = re.compile(r"[-+]?\.?(nan|inf|infinity)", re.IGNORECASE)


class Scalar(str):
    """A scalar as it was written; what it means, its place in the schema decides."""

    __slots__ = ("quoted",)
    quoted: bool


class StrictSchema(BaseModel):
    """Base of file schemas: an unknown key is a mistake."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=False)


def _number(value: object) -> object:
    if not isinstance(value, str):
        raise ValueError(f"{describe(value)} is not a number")  # noqa: TRY004 - pydantic collects ValueError
    if getattr(value, "quoted", False):
        raise ValueError(f'"{value}" is text, not a number; take the quotes away')
    if _NOT_FINITE.fullmatch(value):
        raise ValueError(f"{value} is not a finite number")
    if _LEADING_ZERO.match(value):
        raise ValueError(f"{value} is ambiguous (octal in YAML); write it without the leading zero")
    if not _DECIMAL.fullmatch(value) or not re.search(r"\d", re.split("[eE]", value)[0]):
        raise ValueError(f"{describe(value)} is not a number; write it like 12, -0.5 or 1e-3")
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{value} is too large")
    return number


def _whole(value: object) -> object:
    number = _number(value)
    if not (isinstance(number, float) and number.is_integer()):
        raise ValueError(f"{value} is not a whole number")
    return int(number)


def _text(value: object) -> object:
    if not isinstance(value, str) or (not value.strip() and not getattr(value, "quoted", False)):
        raise ValueError(f"{describe(value)} is not text")
    return str(value)


def _empty_is_none(value: object) -> object:
    return None if isinstance(value, Scalar) and not value.quoted and value in {"", "~", "null"} else value


#: field types of a schema, read from the text as written; constraints stand inside, where JSON Schema sees them
AsNumber = BeforeValidator(_number)
Number = Annotated[float, AsNumber]
Positive = Annotated[float, Field(gt=0), AsNumber]
NotNegative = Annotated[float, Field(ge=0), AsNumber]
Count = Annotated[int, Field(ge=0), BeforeValidator(_whole)]
Text = Annotated[str, BeforeValidator(_text)]
Name = Annotated[str, Field(min_length=1), BeforeValidator(_text)]
#: put before ``X | None``: ``key:`` and ``key: null`` mean the same as leaving it out
EmptyIsNone = BeforeValidator(_empty_is_none)


def describe(value: object) -> str:
    """What a value is, in a user's words."""
    if isinstance(value, dict):
        return "a group of keys"
    if isinstance(value, list):
        return "a list"
    if value is None or value == "":
        return "nothing"
    text = str(value)
    return f"'{text}'" if len(text) <= 40 else f"'{text[:37]}...'"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Document:
    """A YAML file as plain dicts, lists and :class:`Scalar`, with the place of each value."""

    path: str
    sha256: str
    data: dict[str, Any]
    #: (line, column), one-based, of each value and of each key
    places: dict[KeyPath, Place]
    key_places: dict[KeyPath, Place]
    #: found while reading: duplicate keys
    mistakes: tuple[_Located, ...]
    error: type[InputError]

    def validate(
        self, schema: type[Schema], checks: Callable[[dict[str, Any]], Iterable[Mistake]] = lambda _: ()
    ) -> Schema:
        """The document as ``schema``; ``checks`` looks at the raw data for what one field alone cannot show.

        Raises:
            InputError: (of the kind given on reading) one line a mistake, ``file:line:col: key: what is wrong``.
        """
        self._refuse_another_kind(schema)
        mistakes = [*self.mistakes, *((self._place(path), path, text) for path, text in checks(self.data))]
        try:
            result = schema.model_validate(self.data)
        except ValidationError as error:
            mistakes += [self._locate(schema, details) for details in error.errors(include_url=False)]
        else:
            if not mistakes:
                return result
        raise self._refusal(mistakes)

    def _refuse_another_kind(self, schema: type[BaseModel]) -> None:
        """A calibration given as a frame is one mistake, not one for every key."""
        (expected,) = get_args(schema.model_fields["schema_"].annotation)
        written = self.data.get("schema")
        if isinstance(written, str) and written.startswith(FAMILY) and _kind(written) != _kind(expected):
            what = f"this is a {_kind(written)} file, but a {_kind(expected)} file ('{expected}') is needed here"
            raise self._refusal([(self._place(("schema",)), ("schema",), what)])

    def _refusal(self, mistakes: Iterable[_Located]) -> InputError:
        lines = [
            f"{self.path}:{line}:{column}: {_dotted(path)}: {text}"
            for (line, column), path, text in sorted(mistakes, key=_order)
        ]
        if len(lines) > MAX_MISTAKES_SHOWN:
            lines[MAX_MISTAKES_SHOWN:] = [f"{self.path}: ... and {len(lines) - MAX_MISTAKES_SHOWN} more mistakes"]
        return self.error("\n".join(lines))

    def _locate(self, schema: type[BaseModel], details: ErrorDetails) -> _Located:
        path, text = _explain(schema, details)
        unknown = details["type"] == "extra_forbidden"
        return (self.key_places[path] if unknown else self._place(path)), path, text

    def _place(self, path: KeyPath) -> Place:
        while path not in self.places:
            path = path[:-1]  # a missing key: the group it is missing from
        return self.places[path]


def _kind(schema: str) -> str:
    return schema.removeprefix(FAMILY).split("/")[0]


def _dotted(path: KeyPath) -> str:
    return ".".join(map(str, path)) or "file"


def _order(mistake: _Located) -> tuple[Place, str, str]:
    place, path, text = mistake
    return place, _dotted(path), text


def read_document(path: str | Path, error: type[InputError]) -> Document:
    """Read a YAML file whose top level is a group of keys.

    Raises:
        InputError: (of the kind ``error``) the file cannot be read, is not UTF-8, too big, or not such YAML.
    """
    raw = _read(Path(path), path, error)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        line = raw[: problem.start].count(b"\n") + 1
        raise error(f"{path}:{line}: is not UTF-8 text; save it as UTF-8") from problem
    try:
        node = _Loader(text).get_single_node()
    except yaml.MarkedYAMLError as problem:
        raise error(_syntax_sentence(path, problem)) from problem
    except yaml.YAMLError as problem:
        reason = str(problem).splitlines()[0]
        raise error(f"{path}: is not YAML ({reason})") from problem
    if node is None:
        raise error(f"{path}: is empty")
    if not isinstance(node, yaml.MappingNode):
        raise error(
            f"{path}:1:1: must hold keys like 'schema: ...', but it holds {describe(_Builder().build(node, ()))}"
        )
    builder = _Builder()
    data = builder.build(node, ())
    return Document(
        path=str(path),
        sha256=hashlib.sha256(raw).hexdigest(),
        data=data,
        places=builder.places,
        key_places=builder.key_places,
        mistakes=tuple(builder.mistakes),
        error=error,
    )


def _read(file: Path, path: str | Path, error: type[InputError]) -> bytes:
    try:
        with file.open("rb") as stream:
            raw = stream.read(MAX_BYTES + 1)
    except FileNotFoundError as problem:
        raise error(f"{path}: no such file") from problem
    except OSError as problem:
        raise error(f"{path}: cannot be read ({problem.strerror})") from problem
    if len(raw) > MAX_BYTES:
        raise error(f"{path}: is larger than {MAX_BYTES // 1024} kB; that is no file of this kind")
    return raw


def _syntax_sentence(path: str | Path, problem: yaml.MarkedYAMLError) -> str:
    mark = problem.problem_mark or problem.context_mark
    place = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
    what = problem.problem or problem.context or "unreadable"
    if "\\t" in what:
        what = "a tab; YAML is indented with spaces only"
    return f"{path}{place}: is not YAML: {what}"


class _Loader(yaml.SafeLoader):
    """PyYAML up to its node tree, without the parts that can surprise."""

    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        if getattr(event, "anchor", None):  # an alias carries the name of its anchor
            raise yaml.composer.ComposerError(
                None, None, "anchors and aliases are not allowed; write it out", event.start_mark
            )
        if getattr(event, "tag", None):
            raise yaml.composer.ComposerError(None, None, f"tags like {event.tag} are not allowed", event.start_mark)
        if self._depth >= MAX_DEPTH:
            raise yaml.composer.ComposerError(None, None, "nested too deeply", event.start_mark)
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1


@dataclass(slots=True)
class _Builder:
    places: dict[KeyPath, Place] = field(default_factory=dict)
    key_places: dict[KeyPath, Place] = field(default_factory=dict)
    mistakes: list[_Located] = field(default_factory=list)

    def build(self, node: yaml.Node, path: KeyPath) -> Any:
        self.places[path] = _place(node)
        if isinstance(node, yaml.MappingNode):
            return dict(self._items(node, path))
        if isinstance(node, yaml.SequenceNode):
            return [self.build(child, (*path, i)) for i, child in enumerate(node.value)]
        scalar = Scalar(node.value)
        scalar.quoted = isinstance(node, yaml.ScalarNode) and node.style is not None
        return scalar

    def _items(self, node: yaml.MappingNode, path: KeyPath) -> Iterator[tuple[str, Any]]:
        for key_node, value_node in node.value:
            place = _place(key_node)
            if not isinstance(key_node, yaml.ScalarNode):
                self.mistakes.append((place, path, "a key must be one word"))
                continue
            key_path = (*path, key_node.value)
            if key_path in self.key_places:
                line, _ = self.key_places[key_path]
                self.mistakes.append((place, key_path, f"is written twice, first in line {line}; take one away"))
                continue
            self.key_places[key_path] = place
            yield key_node.value, self.build(value_node, key_path)


def _place(node: yaml.Node) -> Place:
    return node.start_mark.line + 1, node.start_mark.column + 1


def _explain(schema: type[BaseModel], details: ErrorDetails) -> Mistake:
    """A pydantic error in a user's words."""
    path: KeyPath = details["loc"]
    context = details.get("ctx", {})
    value = details["input"]
    group = _schema_at(schema, path[:-1])
    match details["type"]:
        case "missing":
            meaning = _fields(group)[str(path[-1])] if group else ""
            text = f"is missing: {meaning}" if meaning else "is missing"
        case "extra_forbidden":
            allowed = list(_fields(group)) if group else []
            near = difflib.get_close_matches(str(path[-1]), allowed, n=1)
            text = "unknown key" + (f"; did you mean {near[0]}?" if near else "") + f" (allowed: {', '.join(allowed)})"
        case "literal_error":
            text = f"{describe(value)} is not allowed; write {context['expected']}"
        case "list_type" | "tuple_type":
            text = f"must be a list, not {describe(value)}"
        case "model_type" | "dict_type" | "model_attributes_type":
            inner = _schema_at(schema, path)
            text = f"must be a group of keys ({', '.join(_fields(inner)) if inner else ''}), not {describe(value)}"
        case "too_short" | "too_long":
            wanted = context.get("min_length", context.get("max_length"))
            text = f"needs {wanted} values, has {len(value)}"
        case "string_too_short":
            text = "is empty"
        case "greater_than":
            text = f"{value:g} is out of range; it must be more than {context['gt']:g}"
        case "greater_than_equal":
            text = f"{value:g} is out of range; it must not be less than {context['ge']:g}"
        case "less_than_equal":
            text = f"{value:g} is out of range; it must not be more than {context['le']:g}"
        case "value_error":
            text = str(context["error"])
        case _:
            text = details["msg"]
    return path, text


def _fields(schema: type[BaseModel]) -> dict[str, str]:
    """Keys of a group with their descriptions."""
    return {info.alias or name: info.description or "" for name, info in schema.model_fields.items()}


def _schema_at(schema: type[BaseModel] | None, path: KeyPath) -> type[BaseModel] | None:
    for key in path:
        if schema is None or isinstance(key, int):
            continue
        infos = {info.alias or name: info for name, info in schema.model_fields.items()}
        schema = _group_in(infos[key].annotation) if key in infos else None
    return schema


def _group_in(annotation: object) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((group for part in get_args(annotation) if (group := _group_in(part))), None)
