"""The generated messages, named once."""

from muster._proto.muster.executor.v1 import executor_pb2 as executor
from muster._proto.muster.framework.v1 import framework_pb2 as framework

__all__ = ["executor", "framework"]
