"""What is said of an error: the cause itself, which Dr.Jit hides behind its loops."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

# The end of Dr.Jit's sentence about an error in a loop, a branch or a call that it has recorded.
SEE_ABOVE = "(see above)."

Function = TypeVar("Function", bound=Callable)


def cause_of(error: BaseException) -> BaseException:
    """The error that `error` only refers to, or itself."""
    while str(error).endswith(SEE_ABOVE) and (cause := error.__cause__ or error.__context__):
        error = cause
    return error


def raising_causes(function: Function) -> Function:
    """The function, whose errors are the causes themselves.

    A KeyboardInterrupt in a loop is one again, too, and no RuntimeError.
    """

    @functools.wraps(function)
    def wrapper(*args, **kwargs):
        try:
            return function(*args, **kwargs)
        except RuntimeError as error:
            cause = cause_of(error)
            if cause is error:
                raise
        # Out here, since in there the cause would become an effect of its own effect
        raise cause

    return wrapper  # type: ignore[return-value]
