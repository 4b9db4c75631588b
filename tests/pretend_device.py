"""A device that is none: its tensors compute on the CPU, but refuse those of main memory, as a GPU's do.

It finds what a machine without a GPU would not: a tensor made in the wrong place, or NumPy given one of the
device. The arithmetic of a GPU it can't show.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

PRETENDED = torch.device("lazy")  # a name that PyTorch knows and for which it loads nothing

_CROSSING = ("aten::_to_copy", "aten::copy_")
_INDEXED = ("aten::index", "aten::index_put_", "aten::index_put")


class _OnDevice(torch.Tensor):
    """What lies on the pretended device: it says so, and holds a tensor of the CPU."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> _OnDevice:
        made = torch.Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=PRETENDED,
        )
        made.inner = inner
        return made

    def tolist(self) -> Any:
        """Return the numbers in main memory; PyTorch itself refuses this to tensors of other classes."""
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise RuntimeError(f"{func} on the pretended device, outside of it")


class _FromNumbers(TorchFunctionMode):
    """Tensors of Python's numbers: PyTorch makes them below the other mode, so they are carried over here."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.Tensor.new_tensor and args[0].device == PRETENDED:
            like, *numbers = args
            kwargs = {"dtype": like.dtype, **kwargs, "device": PRETENDED}
            func, args = torch.tensor, tuple(numbers)
        if func in (torch.tensor, torch.as_tensor) and torch.device(kwargs.get("device") or "cpu") == PRETENDED:
            del kwargs["device"]
            return func(*args, **kwargs).to(PRETENDED)
        return func(*args, **kwargs)


class PretendedDevice(TorchDispatchMode):
    """Within it `PRETENDED` is a device like any other.

    Attributes:
        crossings: How many numbers came from the device to main memory.
        uploads: How many went from main memory to the device.
    """

    def __init__(self) -> None:
        super().__init__()
        self.crossings = self.uploads = 0
        self._from_numbers = _FromNumbers()

    def __enter__(self) -> PretendedDevice:
        self._from_numbers.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._from_numbers.__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = [part for part in tree_flatten((args, kwargs))[0] if isinstance(part, torch.Tensor)]
        ours = [part for part in tensors if isinstance(part, _OnDevice)]
        asked = kwargs.get("device")
        name = func._schema.name
        if ours and name not in _CROSSING:
            self._refuse_a_mixture(func, name, args, tensors)
        to_device = bool(ours) if asked is None else torch.device(asked).type == PRETENDED.type
        if asked is not None and to_device:
            kwargs["device"] = torch.device("cpu")
        inner = {id(part.inner): part for part in ours}
        plain_args, plain_kwargs = tree_map(
            lambda part: part.inner if isinstance(part, _OnDevice) else part, (args, kwargs)
        )
        made = func(*plain_args, **plain_kwargs)
        if to_device and name in _CROSSING:
            self.uploads += sum(part.numel() for part in tensors if not isinstance(part, _OnDevice))
        if name == "aten::copy_":
            if ours and not isinstance(args[0], _OnDevice):
                self.crossings += made.numel()
            return args[0]
        if name == "aten::_local_scalar_dense" or (ours and not to_device):
            self.crossings += made.numel() if isinstance(made, torch.Tensor) else 1
            return made.clone() if isinstance(made, torch.Tensor) else made
        if not to_device:
            return made

        def back(part: Any) -> Any:
            if not isinstance(part, torch.Tensor):
                return part
            return inner[id(part)] if id(part) in inner else _OnDevice(part)

        return tree_map(back, made)

    @staticmethod
    def _refuse_a_mixture(func: Any, name: str, args: Any, tensors: list[torch.Tensor]) -> None:
        looked_up = tree_flatten(args[1])[0] if name in _INDEXED else []
        for part in tensors:
            excused = part.ndim == 0 or any(part is index for index in looked_up)
            if not isinstance(part, _OnDevice) and not excused:
                raise RuntimeError(f"{func}: a tensor {tuple(part.shape)} of main memory meets the device's")
