# pyright: basic
"""The Python side of a CUDA kernel: two functions whose source text Warp takes into the key of its compiled kernels.

Annotations would say nothing here (the types come from the parameter structure) and would have every kernel of every
user compiled again; that is why this file is checked less strictly than its folder.
"""

from typing import Any


def warp_kernel(wp: Any, name: str, text: str, module: Any, structure: Any, options: dict[str, Any]) -> Any:
    """Warp kernel `name` of `module` with the body `text`; its argument is a `structure`, its task the thread."""

    def native(args, task): ...

    native.__annotations__ = {"args": structure, "task": wp.int32}
    native.__name__ = native.__qualname__ = f"{name}_native"
    function = wp.func_native(text)(native)

    def entry(args):
        function(args, wp.tid())

    entry.__annotations__ = {"args": structure}
    return wp.Kernel(entry, key=name, module=module, options=options)
