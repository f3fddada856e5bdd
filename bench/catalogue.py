"""List of the benchmarks: where each is computed, and with what arguments."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

from longarm_comp.core.errors import InputError

BENCHMARKS: Mapping[str, Mapping[str, tuple[Any, ...]]] = {
    "kinematics": {
        "ik_single_vs_rtb_ik_lm_median": ("kinematics.single", "Toolbox"),
        "ik_warm_vs_rtb_ik_lm_median": ("kinematics.single", "Toolbox", True),
        "ik_batch_vs_rtb_ik_lm_mean": ("kinematics.batch",),
        "ik_grid_vs_rtb_ik_lm_mean": ("kinematics.batch", True),
        "ik_single_vs_pinocchio": ("kinematics.single", "Pinocchio"),
        "ik_single_vs_trac_ik": ("kinematics.single", "TracIk"),
        "ik_single_vs_roboplan": ("kinematics.single", "RoboPlan"),
        "ik_single_vs_ikpy": ("kinematics.single", "IkPy", False, 3),
        "ik_single_uncompiled": ("kinematics.single_uncompiled",),
        "ik_batch_uncompiled": ("kinematics.batch_uncompiled",),
        "ik_compile_seconds": ("kinematics.compile_seconds",),
        "forward_batch_vs_rtb": ("forward.beside_rigid", "roboticstoolbox"),
        "forward_batch_vs_pinocchio": ("forward.beside_rigid", "pinocchio"),
        "forward_batch_model": ("forward.batch_model",),
        "forward_single_model": ("forward.single_model",),
        "forward_cost": ("forward.cost",),
        "columns_single": ("forward.columns", 1),
        "columns_batch": ("forward.columns",),
        "compensate_single": ("compensation.compensate_single",),
        "compensate_batch_10000": ("compensation.compensate_batch_10000",),
        "compensate_path_15": ("compensation.path", 15),
        "compensate_path_15_play": ("compensation.path", 15, True),
        "compensate_path_240": ("compensation.path", 240),
    },
    "ssa": {
        "ssa_evals_vs_mealpy_300": ("ssa_scaling.evals_vs_mealpy", 300),
        "ssa_evals_vs_mealpy_900": ("ssa_scaling.evals_vs_mealpy", 900),
        "ssa_time_to_error_vs_mlp_300": ("ssa_training.time_to_error", "mlp", 300),
        "ssa_time_to_error_vs_gp_300": ("ssa_training.time_to_error", "gp", 300),
        "ssa_time_to_error_vs_mlp_900": ("ssa_training.time_to_error", "mlp", 900),
        "ssa_time_to_error_vs_gp_900": ("ssa_training.time_to_error", "gp", 900),
        "ssa_train_300": ("ssa_training.defaults", 300),
        "ssa_train_900": ("ssa_training.defaults", 900),
        "ssa_search_population_10000": ("ssa_scaling.search_population", 10_000),
        "ssa_train_100000": ("ssa_scaling.train_many", 100_000),
        "ssa_gpu_search_population_10000": ("ssa_scaling.search_on_gpu", 10_000),
        "ssa_gpu_train_100000": ("ssa_scaling.train_on_gpu", 100_000),
    },
    "calibration": {
        "calibrate_300": ("calibration.against_samples", 300),
        "calibrate_3000": ("calibration.against_samples", 3_000),
        "calibrate_30000": ("calibration.against_samples", 30_000),
        "calibrate_100000": ("calibration.against_samples", 100_000, 3_000),
        "calibrate_joints": ("calibration.against_joints",),
        "calibrate_vs_scipy": ("calibration.beside_scipy",),
        "calibrate_vs_pybotics": ("calibration.beside_pybotics",),
    },
    "diagnosis": {
        "diagnose_300_vs_goal": ("diagnosis.beside_goal",),
        "diagnose_3000": ("diagnosis.against_samples", 3_000),
        "diagnose_20000": ("diagnosis.against_samples", 20_000),
        "diagnose_candidates": ("diagnosis.against_candidates",),
    },
    "bags": {
        "bag_read_vs_rosbags": ("bags.read", "rosbags"),
        "bag_read_vs_mcap_ros2": ("bags.read", "mcap"),
        "bag_record_vs_rosbags": ("bags.record",),
        "bag_read_1gb": ("bags.read_large",),
    },
    "startup": {
        "start_help": ("startup.beside_floor", "help"),
        "start_import_arm": ("startup.beside_floor", "arm"),
        "start_import_core": ("startup.beside_floor", "core"),
        "start_simulated_arm": ("node_start.node", "simulated_arm"),
        "start_servo_driver": ("node_start.node", "servo_driver"),
        "start_stereo_bridge": ("node_start.node", "stereo_bridge"),
        "start_kinematics": ("node_start.node", "kinematics"),
        "start_error_predictor": ("node_start.node", "error_predictor"),
        "kinematics_back_after_kill": ("recovery.back_after_kill",),
        "nodes_end_after_interrupt": ("recovery.end_after_interrupt",),
    },
    "ros": {
        "ros_target_to_trajectory_vs_echo_p50_ms": ("ros.beside_echo", "topic", 50),
        "ros_target_to_trajectory_vs_echo_p99_ms": ("ros.beside_echo", "topic", 99),
        "ros_compensate_vs_echo_p50_ms": ("ros.beside_echo", "service", 50),
        "ros_compensate_vs_echo_p99_ms": ("ros.beside_echo", "service", 99),
        "ros_share_dds_ms": ("ros.share", "dds"),
        "ros_share_predictor_ms": ("ros.share", "predictor"),
        "ros_share_ik_ms": ("ros.share", "ik"),
        "ros_share_node_ms": ("ros.share", "node"),
        "ros_sustained_rate_vs_echo_hz": ("ros.sustained_rate",),
        "ros_flood_compensate_p99_ms": ("ros.answer_under_flood",),
    },
}
"""By kind and name: function, as `module.function` of this folder, and its arguments."""

KIND_OF = {name: kind for kind, names in BENCHMARKS.items() for name in names}


def chosen(names: Sequence[str]) -> tuple[str, ...]:
    """Benchmarks selected by names or kinds (`ros`); without names all of them.

    Raises:
        InputError: no such name or kind.
    """
    selected: list[str] = []
    for name in names:
        alike = [known for known, kind in KIND_OF.items() if name in (known, kind)]
        if not alike:
            raise InputError("bench", "name", name, ", ".join((*KIND_OF, *BENCHMARKS)))
        selected += [known for known in alike if known not in selected]
    return tuple(selected) or tuple(KIND_OF)


def run(name: str) -> Mapping[str, object]:
    """One row: name, value, unit, peer, peer_value, ratio (above 1: faster than the peer), spread.

    Raises:
        InputError: no benchmark of this name.
        JobError: it could not be measured.
    """
    if name not in KIND_OF:
        raise InputError("bench", "name", name, ", ".join(KIND_OF))
    place, *given = BENCHMARKS[KIND_OF[name]][name]
    module, _, function = place.partition(".")
    row = getattr(importlib.import_module(f"bench.{module}"), function)(*given)
    return {"name": name, **row}
