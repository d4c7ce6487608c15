"""The options of a command: all fields of its configurations in one namespace, so that an option has one name in every command."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, cast, get_type_hints

import tyro

from bbfit.checks import fail

# Types that are made at run time, of which mypy would have to know the parts.
_Annotated, _Hidden, _Flat = cast(Any, Annotated), cast(Any, tyro.conf.Suppress), cast(Any, tyro.conf.OmitArgPrefixes)
# The help describes the default of an option that is None if it is not given.
_NO_DEFAULT = tyro.conf.arg(help_behavior_hint="")
_DOTTED = re.compile(r"--(\w+)\.([\w-]+)(=.*)?$")
_RENAMED = {
    "--fit.crispness-weight": "--binarization-weight",
    "--fit.placement-rate": "--placement-learning-rate",
    "--fit.revisions": "--refinement-rounds",
    "--fit.searches": "--restarts",
    "--views.device": "--render-device",
    "--views.workers": "--render-workers",
}


def deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """A function for tyro that takes the options of a command and returns the call to make.

    The fields of every configuration become options without a prefix; the help lists them under the configuration's name. If two
    configurations have a field in common, the first one takes the option and the second one keeps its default. Where the command has a
    ``seed``, it is that of all configurations, and each has an option ``--NAME.seed`` that overrides it.
    """
    signature, hints = inspect.signature(command), get_type_hints(command, include_extras=True)
    stages: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    taken, parameters = set(hints) - set(stages), []
    for parameter in signature.parameters.values():
        kind, default = hints[parameter.name], parameter.default
        if parameter.name in stages:
            default = _flattened(default, parameter.name, taken)
            kind = _Flat[type(default)]
        elif default is None:
            kind = _Annotated[kind, _NO_DEFAULT]
        parameters.append(parameter.replace(annotation=kind, default=default))

    def bind(*args: Any, **options: Any) -> Callable[[], None]:
        for name, kind in stages.items():
            values = vars(options[name])
            if values.get("seed", 0) is None:
                values = values | {"seed": options["seed"]}
            options[name] = kind(**values)
        return functools.partial(command, *args, **options)

    bind.__doc__, bind.__name__ = command.__doc__, command.__name__
    bind.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    bind.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return bind


def described(command: Callable[..., None]) -> Callable[[], Any]:
    """A function for tyro that has the description of a command but not its options, which take long to make."""

    def unused() -> None:
        raise AssertionError("the program has the options of the command that is called")

    unused.__doc__ = command.__doc__
    return unused


def _flattened(default: Any, name: str, taken: set[str]) -> Any:
    """A configuration of a type in which the options in ``taken`` are hidden; those of its fields are added to them."""
    kind, hints = type(default), get_type_hints(type(default), include_extras=True)
    changed = {option: _Annotated[hints[option], _NO_DEFAULT] for option, value in vars(default).items() if value is None}
    changed |= {field.name: _Hidden[hints[field.name]] for field in fields(kind) if field.name in taken}
    if "seed" in changed:
        changed["seed"] = _Annotated[int | None, tyro.conf.arg(name=f"{name}.seed"), _NO_DEFAULT]
    taken.update(hints)
    body = {"__annotations__": changed, "__doc__": kind.__doc__, "__module__": kind.__module__}
    values = vars(default) | dict.fromkeys(changed.keys() & {"seed"})
    flat: Any = dataclass(frozen=True)(type(kind.__name__, (kind,), body))
    return flat(**values)


def refuse_old(arguments: Sequence[str]) -> None:
    """Refuse the options of earlier versions: raise an InputError that names the options to use instead."""
    for argument in arguments:
        if argument.partition("=")[0] == "--hull":
            fail("--hull", "is no option any more", "use --outline hull, with --corners for fewer than 8 corners")
        if (dotted := _DOTTED.match(argument)) and dotted[2] != "seed":
            option = f"--{dotted[1]}.{dotted[2]}"
            fail(option, "options have no prefix any more", f"use {_RENAMED.get(option, f'--{dotted[2]}')}")
