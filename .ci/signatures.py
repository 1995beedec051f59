"""Show the arguments of the environment on the site, where its source has `**arguments`."""

import inspect
from typing import Any

import griffe

from mptc_gym import MiddlePointEnv


class SpellOutArguments(griffe.Extension):
    """Replace `**arguments` of `MiddlePointEnv` by the arguments of the environment."""

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        """Spell out the arguments in the signature of `MiddlePointEnv`.

        griffe calls this method for each class that it reads.
        """
        if cls.name != "MiddlePointEnv":
            return
        parameters = cls.members["__init__"].parameters
        del parameters["arguments"]
        for name, argument in inspect.signature(MiddlePointEnv).parameters.items():
            if name in parameters:
                continue
            spelled_out = griffe.Parameter(
                name,
                kind=griffe.ParameterKind.keyword_only,
                annotation=inspect.formatannotation(argument.annotation).strip("'"),
                default=repr(argument.default),
            )
            parameters.add(spelled_out)
