# pyright: basic
"""The Python side of a CUDA kernel: two functions whose source text is part of the key of Warp's kernel cache.

The two functions have no annotations: their types come from the parameter structure, and changing their text would
recompile every user's kernels. Pyright therefore checks this file less strictly than its folder.
"""

from typing import Any


def warp_kernel(wp: Any, name: str, text: str, module: Any, structure: Any, options: dict[str, Any]) -> Any:
    """Warp kernel `name` of `module` with the body `text`, whose arguments are a `structure` and the thread number."""

    def native(args, task): ...

    native.__annotations__ = {"args": structure, "task": wp.int32}
    native.__name__ = native.__qualname__ = f"{name}_native"
    function = wp.func_native(text)(native)

    def entry(args):
        function(args, wp.tid())

    entry.__annotations__ = {"args": structure}
    return wp.Kernel(entry, key=name, module=module, options=options)
