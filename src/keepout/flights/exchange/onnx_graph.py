"""An ONNX graph put together node by node: names are given, and each operator is one call."""

from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET = 18
IR_VERSION = 9
"""Of ONNX 1.14 (2023): what reads that or later reads these files."""

_TYPES = {np.dtype(np.float32): TensorProto.FLOAT, np.dtype(np.float64): TensorProto.DOUBLE}


class Graph:
    """Nodes and constants in the order in which they were asked for; values are known by their names."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._named: dict[tuple[str, bytes, tuple[int, ...]], str] = {}

    def constant(self, value: Any, dtype: Any = np.float64) -> str:
        """Give the name of a constant; equal ones are kept once."""
        array = np.ascontiguousarray(value, dtype)
        key = (array.dtype.str, array.tobytes(), array.shape)
        if key not in self._named:
            self._named[key] = f"constant_{len(self._constants)}"
            self._constants.append(numpy_helper.from_array(array, self._named[key]))
        return self._named[key]

    def apply(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Append an operator with one output and give the output's name."""
        name = f"{operator}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(operator, list(inputs), [name], name=name, **attributes))
        return name

    def named(self, value: str, name: str) -> None:
        """Give a value a second name, as an output has one."""
        self._nodes.append(helper.make_node("Identity", [value], [name], name=name))

    def cast(self, value: str, dtype: np.dtype) -> str:
        """Change the float type."""
        return self.apply("Cast", value, to=_TYPES[dtype])

    def dot(self, left: str, right: str) -> str:
        """Sum the products along the second axis, which stays with length 1."""
        axes = self.constant([1], np.int64)
        return self.apply("ReduceSum", self.apply("Mul", left, right), axes, keepdims=1)

    def model(self, inputs: dict[str, list[Any]], outputs: dict[str, list[Any]], said: str) -> Any:
        """Give the model with float64 inputs and outputs of these shapes.

        Raises:
            onnx.checker.ValidationError: the graph is no graph.

        """
        described = [
            [helper.make_tensor_value_info(name, TensorProto.DOUBLE, shape) for name, shape in values.items()]
            for values in (inputs, outputs)
        ]
        graph = helper.make_graph(self._nodes, "keepout_field", *described, initializer=self._constants)
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="keepout"
        )
        model.doc_string = said
        onnx.checker.check_model(model, full_check=True)
        return model
