"""The generated messages, named once."""

from muster._proto.muster.executor.v1 import executor_pb2 as executor
from muster._proto.muster.framework.v1 import framework_pb2 as framework
from muster._proto.muster.gate.v1 import gate_pb2 as gate
from muster._proto.muster.sensor.v1 import sensor_pb2 as sensor

__all__ = ["executor", "framework", "gate", "sensor"]
