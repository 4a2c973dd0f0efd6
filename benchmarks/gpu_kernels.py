"""Kernels and memory traffic of one step on an H100, counted in programs compiled without it.

`python benchmarks/gpu_kernels.py [case ...] [--gradient] [--lanes N]` prints a row for each case
and writes results/gpu_kernels.csv. Needs jax's CUDA plugin and compiler, but no device:
`pip install "jax[cuda12]"`. float32. gpu.py measures on a device.

Columns: `kernels`, the fusions and copies in the bodies of the program's loops, which one step
    starts; `kB per lane`, what they read and write in one step, each operand as a whole, so that it
    is the most; `memory MB`, that of the plan for all lanes, arguments and results included. Of a
    gradient the two loops are counted together: one goes forward, one replays a step and goes
    backward.
"""

import argparse
import csv
import math
import os
import re

os.environ["JAX_PLATFORMS"] = "cpu"

import gpu
import jax
import speed_cases
from gpu_table import Row
from jax.experimental import topologies
from jax.sharding import SingleDeviceSharding

H100 = """
gpu_device_info {
  threads_per_block_limit: 1024 threads_per_warp: 32 shared_memory_per_block: 49152
  shared_memory_per_core: 233472 threads_per_core_limit: 2048 core_count: 132 fpus_per_core: 128
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  memory_bandwidth: 3352320000000 l2_cache_size: 52428800 clock_rate_ghz: 1.98
  device_memory_size: 84942979072 shared_memory_per_block_optin: 232448
  cuda_compute_capability { major: 9 } registers_per_core_limit: 65536
  registers_per_block_limit: 65536
}
platform_name: "CUDA" dnn_version_info { major: 9 minor: 1 }
device_description_str: "NVIDIA H100 80GB HBM3"
"""
HEAD = ["case", "what", "lanes", "kernels", "kB per lane", "memory MB", "compile s", "jax"]
BYTES = {"f32": 4, "f64": 8, "s32": 4, "u32": 4, "s64": 8, "pred": 1}
STEPS = 10


def compile_case(name: str, what: str, lanes: int) -> gpu.Program:
    """Return the compiled program of a case for an H100."""
    # svkc reads the platform where it traces
    jax.default_backend = lambda: "gpu"
    chain, state = speed_cases.load_case(name)
    topology = topologies.get_topology_desc(
        platform="cuda", topology_name="h100", target_config=H100, topology="1x1x1"
    )
    place = SingleDeviceSharding(topology.devices[0])
    batch = lambda x: jax.ShapeDtypeStruct((lanes, *x.shape), x.dtype, sharding=place)
    function = gpu.KINDS[what](gpu.svkc_model(chain, state), STEPS)
    # the fastest of several kernels can be chosen on the device alone
    options = {"xla_gpu_autotune_level": 0}
    return gpu.Program(function, jax.tree.map(batch, state), options)


def count_in_loops(text: str) -> tuple[int, int]:
    """Return the kernels in the bodies of a compiled module's loops, and their bytes."""
    kernels = traffic = 0
    for body in set(re.findall(r"body=%?([\w.\-]+)", text)):
        start = text.index(f"\n%{body} ")
        bytes_by_name = {}
        instructions = re.findall(
            r"^ +(?:ROOT )?%([\w.\-]+) = (.*?) ([\w\-]+)\((.*?)\)",
            text[start : text.index("\n}", start)],
            re.MULTILINE,
        )
        for name, shape, operation, operands in instructions:
            bytes_by_name[name] = bytes_of(shape)
            if operation in ("fusion", "copy"):
                read = set(re.findall(r"%([\w.\-]+)", operands))
                kernels += 1
                traffic += bytes_by_name[name] + sum(bytes_by_name[x] for x in read)
    return kernels, traffic


def bytes_of(shape: str) -> int:
    """Return the bytes of all arrays in a shape of an HLO module."""
    return sum(
        BYTES[kind] * math.prod(map(int, filter(None, axes.split(","))))
        for kind, axes in re.findall(rf"\b({'|'.join(BYTES)})\[([\d,]*)\]", shape)
    )


def main(cases: list[str], what: str, lanes: int):
    """Count, print and save all cases."""
    path = gpu.HERE / "results" / "gpu_kernels.csv"
    print("| " + " | ".join(HEAD) + " |", flush=True)
    for name in cases:
        program = compile_case(name, what, lanes)
        kernels, traffic = count_in_loops(program.program.as_text() or "")
        row = Row(case=name, dtype="float32", lanes=lanes, what=what, by="svkc")
        row.compiled(program)
        cells = [name, what, lanes, kernels, f"{traffic / lanes / 1e3:.0f}", f"{row.memory:.0f}"]
        cells = [*map(str, cells), f"{row.compile_seconds[2]:.0f}", jax.__version__]
        print("| " + " | ".join(cells) + " |", flush=True)
        kept = list(csv.reader(path.open()))[1:] if path.exists() else []
        kept = [other for other in kept if other[:3] != cells[:3]]
        with path.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([HEAD, *kept, cells])


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", nargs="*", metavar="case")
    parser.add_argument("--gradient", action="store_true")
    parser.add_argument("--lanes", type=int, default=16384)
    options = parser.parse_args()
    what = "gradient" if options.gradient else "steps"
    main(options.cases or list(speed_cases.CASES), what, options.lanes)
