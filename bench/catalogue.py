"""List of the benchmarks by name; each is a function of that name in its module."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence

from longarm_comp.core.errors import InputError

BENCHMARKS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "kinematics": {
        "kinematics": (
            "ik_single_vs_rtb_ik_lm_median",
            "ik_warm_vs_rtb_ik_lm_median",
            "ik_batch_vs_rtb_ik_lm_mean",
            "ik_batch_all_cores_vs_rtb_ik_lm_mean",
            "ik_grid_vs_rtb_ik_lm_mean",
            "ik_single_vs_pinocchio",
            "ik_single_vs_trac_ik",
            "ik_single_vs_roboplan",
            "ik_single_vs_ikpy",
            "ik_single_without_compiler",
            "ik_batch_without_compiler",
            "ik_compile_seconds",
        ),
        "forward": (
            "forward_batch_vs_rtb",
            "forward_batch_vs_pinocchio",
            "forward_batch_model",
            "forward_batch_arrays",
            "forward_single_model",
            "forward_single_python",
            "forward_cost",
            "columns_single",
            "columns_batch",
        ),
        "compensation": ("compensate_single", "compensate_batch_10000"),
    },
    "ssa": {
        "ssa": ("ssa_evals_vs_mealpy_300", "ssa_evals_vs_mealpy_900"),
        "ssa_training": (
            "ssa_time_to_error_vs_mlp_300",
            "ssa_time_to_error_vs_gp_300",
            "ssa_time_to_error_vs_mlp_900",
            "ssa_time_to_error_vs_gp_900",
        ),
        "ssa_scaling": (
            "ssa_search_population_10000",
            "ssa_train_100000",
        ),
    },
    "calibration": {
        "calibration": (
            "calibrate_300",
            "calibrate_3000",
            "calibrate_30000",
            "calibrate_100000",
            "calibrate_joints",
            "calibrate_vs_scipy",
            "calibrate_vs_pybotics",
        ),
    },
    "diagnosis": {
        "diagnosis": (
            "diagnose_300_vs_goal",
            "diagnose_3000",
            "diagnose_20000",
            "diagnose_candidates",
        ),
    },
    "bags": {
        "bags": (
            "bag_read_vs_rosbags",
            "bag_read_vs_mcap_ros2",
            "bag_record_vs_rosbags",
            "bag_write_vs_mcap_ros2",
            "bag_read_1gb",
        ),
    },
    "startup": {
        "startup": ("start_help", "start_import_arm", "start_import_core"),
        "node_start": (
            "start_simulated_arm",
            "start_servo_driver",
            "start_stereo_bridge",
            "start_kinematics",
            "start_error_predictor",
        ),
        "recovery": ("kinematics_back_after_kill", "nodes_end_after_interrupt"),
    },
    "ros": {
        "ros": (
            "ros_target_to_trajectory_vs_echo_p50_ms",
            "ros_target_to_trajectory_vs_echo_p99_ms",
            "ros_compensate_vs_echo_p50_ms",
            "ros_compensate_vs_echo_p99_ms",
            "ros_share_dds_ms",
            "ros_share_predictor_ms",
            "ros_share_ik_ms",
            "ros_share_node_ms",
            "ros_sustained_rate_vs_echo_hz",
            "ros_flood_compensate_p99_ms",
            "ros_composed_target_to_trajectory_vs_echo_p50_ms",
            "ros_composed_target_to_trajectory_vs_echo_p99_ms",
            "ros_composed_compensate_vs_echo_p50_ms",
            "ros_composed_compensate_vs_echo_p99_ms",
        ),
    },
}
"""Names by kind and module. Some names are fixed by agreement; each gives one row."""

MODULE_OF = {
    name: module
    for modules in BENCHMARKS.values()
    for module, names in modules.items()
    for name in names
}
KIND_OF = {
    name: kind
    for kind, modules in BENCHMARKS.items()
    for names in modules.values()
    for name in names
}


def chosen(names: Sequence[str]) -> tuple[str, ...]:
    """Benchmarks selected by names or kinds (`ros`); without names all of them.

    Raises:
        InputError: no such name or kind.
    """
    selected: list[str] = []
    for name in names:
        alike = [known for known, kind in KIND_OF.items() if name in (known, kind)]
        if not alike:
            raise InputError("bench", "name", name, ", ".join((*MODULE_OF, *BENCHMARKS)))
        selected += [known for known in alike if known not in selected]
    return tuple(selected) or tuple(MODULE_OF)


def run(name: str) -> Mapping[str, object]:
    """One row: name, value, unit, peer, peer_value, ratio (above 1: faster than the peer), spread.

    Raises:
        InputError: no benchmark of this name.
        JobError: it could not be measured.
    """
    if name not in MODULE_OF:
        raise InputError("bench", "name", name, ", ".join(MODULE_OF))
    module = importlib.import_module(f"bench.{MODULE_OF[name]}")
    row: Mapping[str, object] = getattr(module, name)()
    return row
