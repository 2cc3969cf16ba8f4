"""Parts of an update that a GPU replays as one graph, instead of being handed hundreds of small kernels one by one."""

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import torch as th
from torch import nn


def graphed(
    function: Callable[..., Any], network: nn.Module, optimizer: th.optim.Optimizer | None = None
) -> Callable[..., Any]:
    """
    :param function: See ``GraphedFunction``
    :param network: Whose parameters and buffers it reads
    :param optimizer: Of the parameters whose gradients it leaves
    :return: The function, replayed as a graph where the network is on a GPU
    """
    on_gpu = any(parameter.is_cuda for parameter in network.parameters())
    return GraphedFunction(function, network, optimizer) if on_gpu else function


class GraphedFunction:
    """
    A function of tensors that a GPU replays as a graph (``torch.cuda.CUDAGraph``). Elsewhere it is just called.

    A graph holds addresses, shapes and numbers as they were when it was captured. The function must therefore not wait for the
    GPU, and what changes from call to call must come with its arguments or change in place. A graph is captured when a call
    has the shapes of the call before, and the network still lies where it lay then; any other call is an ordinary one. Random
    numbers are those that an ordinary call would draw.

    :param function: Of tensors, or of named tuples or dicts of tensors, to a tensor or a tuple of them. It may leave gradients
    :param network: Whose parameters and buffers it reads
    :param optimizer: Of the parameters whose gradients it leaves, by a backward pass after ``zero_grad(set_to_none=True)``
    """

    def __init__(self, function: Callable[..., Any], network: nn.Module, optimizer: th.optim.Optimizer | None = None) -> None:
        self.function, self.network, self.optimizer = function, network, optimizer
        self.enabled = True
        self.clear()

    def clear(self) -> None:
        """Forget the graph, as after a change of a setting or of the network's modules."""
        # Tensors are replaced in these tables; to walk through the modules at every call would cost as much as the launch
        self._tables = [table for module in self.network.modules() for table in (module._parameters, module._buffers)]
        self._graph: th.cuda.CUDAGraph | None = None
        self._last_layout: Any = None
        self._inputs: list[th.Tensor] = []
        self._outputs: Any = None
        self._gradients: list[tuple[nn.Parameter, th.Tensor]] = []

    def __call__(self, *arguments: Any) -> Any:
        """
        :param arguments: Of the function
        :return: What it returns
        """
        inputs = list(_tensors(arguments))
        if not self.enabled or inputs[0].device.type != "cuda":
            return self.function(*arguments)
        layout = self._layout(inputs)
        if layout != self._last_layout:
            self.clear()
            self._last_layout = layout
            return self.function(*arguments)
        if self._graph is None and not self._capture(arguments, inputs):
            return self.function(*arguments)
        assert self._graph is not None
        for static, given in zip(self._inputs, inputs, strict=True):
            static.copy_(given)
        self._graph.replay()
        for parameter, gradient in self._gradients:
            parameter.grad = gradient
        return _mapped(th.Tensor.clone, self._outputs)

    def _layout(self, inputs: list[th.Tensor]) -> Any:
        read = [tensor.data_ptr() for table in self._tables for tensor in table.values() if tensor is not None]
        return [(tensor.shape, tensor.dtype) for tensor in inputs], read

    def _capture(self, arguments: Any, inputs: list[th.Tensor]) -> bool:
        """Whether there is a graph now. Nothing is computed yet."""
        self._inputs = [tensor.detach().clone() for tensor in inputs]
        static = iter(self._inputs)
        arguments = _mapped(lambda _: next(static), arguments)
        graph = th.cuda.CUDAGraph()
        random = th.cuda.get_rng_state()
        try:
            # Of other threads nothing is asked meanwhile
            with th.cuda.graph(graph, capture_error_mode="thread_local"):
                self._outputs = self.function(*arguments)
        except RuntimeError as error:
            self.clear()
            self.enabled = False
            # The generator still takes itself for being captured: give it another state of the same numbers
            other = th.Generator(inputs[0].device)
            other.set_state(random)
            th.cuda.default_generators[th.cuda.current_device()].graphsafe_set_state(other.graphsafe_get_state())
            name = getattr(self.function, "__name__", self.function)
            warnings.warn(f"{name} cannot be replayed as a CUDA graph and is slower without ({error})")
            return False
        self._graph = graph
        if self.optimizer is not None:
            trained = (parameter for group in self.optimizer.param_groups for parameter in group["params"])
            self._gradients = [(parameter, parameter.grad) for parameter in trained if parameter.grad is not None]
        return True


def _tensors(tree: Any) -> Iterator[th.Tensor]:
    """Those in nested tuples and dicts, in order."""
    if isinstance(tree, th.Tensor):
        yield tree
    elif isinstance(tree, dict | tuple):
        for branch in tree.values() if isinstance(tree, dict) else tree:
            yield from _tensors(branch)


def _mapped(function: Callable[[th.Tensor], th.Tensor], tree: Any) -> Any:
    """The same tree with other tensors."""
    if isinstance(tree, th.Tensor):
        return function(tree)
    if isinstance(tree, dict):
        return {name: _mapped(function, branch) for name, branch in tree.items()}
    if isinstance(tree, tuple):
        branches = [_mapped(function, branch) for branch in tree]
        return type(tree)(*branches) if hasattr(tree, "_fields") else tuple(branches)
    return tree
