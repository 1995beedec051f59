"""Show the arguments of the environment on the site, where its source has `**arguments`."""

import inspect
from typing import Any

import griffe

from mptc_gym import MiddlePointEnv


class SpellOutArguments(griffe.Extension):
    """Replace `**arguments` of `MiddlePointEnv` by the arguments that it stands for."""

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        """Change the constructor of the environment."""
        if cls.name != "MiddlePointEnv":
            return
        parameters = cls.members["__init__"].parameters
        del parameters["arguments"]
        for argument in inspect.signature(MiddlePointEnv).parameters.values():
            if argument.name in parameters:
                continue
            parameters.add(
                griffe.Parameter(
                    argument.name,
                    kind=griffe.ParameterKind.keyword_only,
                    annotation=inspect.formatannotation(argument.annotation).strip("'"),
                    default=repr(argument.default),
                )
            )
