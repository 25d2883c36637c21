"""ONNX models from programs that torch.export recorded."""

from __future__ import annotations

import logging
from typing import Any, cast

import torch


def onnx_model(program: torch.export.ExportedProgram, input_name: str, output_name: str) -> Any:
    """The model of a program with one input and one output, an ``onnx.ModelProto``; needs onnx and onnxscript."""
    registry = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = registry.level
    registry.setLevel(logging.ERROR)  # it warns about packages that are not needed
    try:
        found = torch.onnx.export(
            program,
            dynamo=True,
            verbose=False,
            input_names=[input_name],
            output_names=[output_name],
            custom_translation_table={torch.ops.aten.scalar_tensor.default: _exact_scalar},
        )
    finally:
        registry.setLevel(level)
    model = cast(torch.onnx.ONNXProgram, found).model_proto
    _rename_rows(model.graph)
    return model


def _rename_rows(graph: Any) -> None:
    """Call the number of rows "rows" instead of the symbol that torch chose."""
    symbol = graph.input[0].type.tensor_type.shape.dim[0].dim_param
    for value in (*graph.input, *graph.output, *graph.value_info):
        for size in value.type.tensor_type.shape.dim:
            if symbol in size.dim_param:
                size.dim_param = size.dim_param.replace(symbol, "rows")


def _exact_scalar(s: float, dtype: int = 1, layout: str = "", device: str = "", pin_memory: bool = False) -> Any:
    """A number as a constant. torch's own translation rounds it to single precision first: pi is off by 9e-8."""
    import onnx_ir  # noqa: PLC0415  # optional packages
    from onnxscript.onnx_opset import opset18  # noqa: PLC0415

    value: Any = onnx_ir.tensor(s, dtype=onnx_ir.DataType(max(dtype, 1)))
    return opset18.Constant(value=value)
