"""Former names of public classes, attributes and arguments. Each warns when used and goes with the next release."""

import functools
import warnings
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

_Class = TypeVar("_Class", bound=type)
_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


def renamed_classes(module: str, renamed: Mapping[str, type]) -> Callable[[str], type]:
    """The `__getattr__` of a module whose classes had other names: former name to class."""

    def former(name: str) -> type:
        if name not in renamed:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        _warn(f"{module}.{name}", renamed[name].__name__)
        return renamed[name]

    return former


def renamed_attributes(**renamed: str) -> Callable[[_Class], _Class]:
    """Class decorator: former names of attributes and methods, to be read only."""

    def decorate(cls: _Class) -> _Class:
        for former, current in renamed.items():
            setattr(cls, former, _alias(cls.__name__, former, current))
        return cls

    return decorate


def renamed_arguments(**renamed: str) -> Callable[[Callable[_Parameters, _Result]], Callable[_Parameters, _Result]]:
    """Function decorator: former names of keyword arguments."""

    def decorate(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
        @functools.wraps(function)
        def call(*args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
            for former in renamed.keys() & kwargs.keys():
                _warn(f"argument {former} of {function.__qualname__}", renamed[former])
                kwargs[renamed[former]] = kwargs.pop(former)
            return function(*args, **kwargs)

        return call

    return decorate


def _alias(owner: str, former: str, current: str) -> property:
    def read(self: object) -> Any:
        _warn(f"{owner}.{former}", current)
        return getattr(self, current)

    return property(read, doc=f"Deprecated: use `{current}`.")


def _warn(former: str, current: str) -> None:
    warnings.warn(f"{former} is now {current}", DeprecationWarning, stacklevel=3)
