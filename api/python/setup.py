"""Makes the messages from the protobuf files while the package is built; none of them is kept in the tree.

The files are the repository's own (``../proto``). A source distribution is built without the repository, so it
carries copies (``proto``).
"""

import re
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

HERE = Path(__file__).parent.resolve()
CONTRACTS = [
    "muster/framework/v1/framework.proto",
    "muster/executor/v1/executor.proto",
    "muster/gate/v1/gate.proto",
    "muster/sensor/v1/sensor.proto",
]
# Below a package of their own: what stands directly in `muster` is the SDK.
GENERATED = "muster/_proto"


def contracts() -> Path:
    for root in (HERE.parent / "proto", HERE / "proto"):
        if (root / CONTRACTS[0]).is_file():
            return root
    raise SystemExit("muster: there is neither ../proto nor proto; build from the repository or from an sdist")


def generate(to: Path) -> None:
    to.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "grpc_tools.protoc", f"-I{contracts()}", f"--python_out={to}", f"--pyi_out={to}"]
    subprocess.run([*command, *CONTRACTS], check=True)


class BuildMessages(build_py):
    def run(self) -> None:
        if not self.editable_mode:  # pip builds in the tree, where an earlier build may have left removed modules
            shutil.rmtree(Path(self.build_lib) / "muster", ignore_errors=True)
        super().run()
        # An editable install imports from the tree; .gitignore knows the directory.
        root = HERE / "src" if self.editable_mode else Path(self.build_lib)
        generate(root / GENERATED)

    def get_outputs(self, include_bytecode: bool = True) -> "list[str]":
        made = [
            str(Path(self.build_lib) / GENERATED / contract.replace(".proto", ending))
            for contract in CONTRACTS
            for ending in ("_pb2.py", "_pb2.pyi")
        ]
        return [*super().get_outputs(include_bytecode), *made]


class CarryContracts(sdist):
    def make_release_tree(self, base_dir: str, files: "list[str]") -> None:
        super().make_release_tree(base_dir, files)
        for contract in CONTRACTS:
            copy = Path(base_dir) / "proto" / contract
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(contracts() / contract, copy)


def protobuf() -> str:
    """Generated code runs with the protobuf that it was made for, and later up to the next major version."""
    import tempfile

    try:
        import grpc_tools  # noqa: F401  not there while pip only asks what building needs
    except ImportError:
        return "protobuf>=4"
    with tempfile.TemporaryDirectory() as scratch:
        generate(Path(scratch))
        text = (Path(scratch) / CONTRACTS[0].replace(".proto", "_pb2.py")).read_text()
    made_for = re.search(r"^# Protobuf Python Version: (\d+)\.(\d+)\.(\d+)", text, re.MULTILINE)
    if made_for is None:  # before 5.26 nothing is checked
        return "protobuf>=4.21,<6"
    major = int(made_for.group(1))
    return f"protobuf>={'.'.join(made_for.groups())},<{major + 2}"


setup(
    cmdclass={"build_py": BuildMessages, "sdist": CarryContracts},
    install_requires=["grpcio>=1.60", protobuf()],
)
