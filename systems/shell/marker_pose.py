"""The robot's pose on the shell by the markers that its camera sees ([SNAIL] Algorithm 1).

[SNAIL]: Zhang, Lam, "Relative Localization System Design for SnailBot: A Modular
Self-reconfigurable Robot".
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, OutputPort

from systems.cameras import PinholeCamera
from systems.markers.layout import Marker, MarkerMap
from systems.markers.localizer import Localizer, LocalizerParameters, MapLocalizer
from systems.shell.angles import angles_of


def candidate_pose(
    X_RM: RigidTransform, X_CM: RigidTransform, X_CB: RigidTransform
) -> RigidTransform:
    """Returns `X_RB` by one marker: X_RM X_CM^-1 X_CB.

    Args:
        X_RM: the marker in the sphere's frame, by the map.
        X_CM: the marker in the camera, as seen.
        X_CB: the robot in the camera, by the mounting.
    """
    return X_RM.multiply(X_CM.inverse()).multiply(X_CB)


def without_rotations(marker_map: MarkerMap) -> MarkerMap:
    """Returns the map as the printed Algorithm 1 reads it: places of markers, no rotations."""
    markers = {
        marker.id: Marker(marker.id, RigidTransform(marker.X_WM.translation()), marker.size)
        for marker in marker_map
    }
    return replace(marker_map, markers=markers)


def shell_localizer(
    *,
    marker_map: MarkerMap,
    camera: PinholeCamera,
    X_BC: RigidTransform,
    parameters: LocalizerParameters | None = None,
    marker_rotation: bool = True,
) -> MapLocalizer:
    """Returns what solves the robot's pose on the shell from detections.

    With several markers in view their corners are solved together, not one candidate for each: on
    the shell of 25 there is hardly ever more than one.

    Args:
        marker_map: the markers, in the sphere's frame.
        camera: the camera.
        X_BC: pose of the optical frame in the robot's frame.
        parameters: what is trusted.
        marker_rotation: False is the algorithm as printed, for comparison: its line 7 drops the
            marker's own rotation in the sphere's frame, and it goes by one marker (the largest). It
            is right for a marker whose frame is parallel to R (yaw 0, pitch 0), and for no other.
    """
    if not marker_rotation:
        marker_map = without_rotations(marker_map)
        parameters = replace(parameters or LocalizerParameters(), use="best")
    return MapLocalizer(marker_map=marker_map, camera=camera, X_BC=X_BC, parameters=parameters)


class ShellMarkerPose(Localizer):
    """Turns detections into the robot's pose on the shell.

    .. pydrake_system::

        name: ShellMarkerPose
        input_ports:
        - detections
        output_ports:
        - pose
        - alternative
        - health
        - angles

    Args:
        localizer: the algorithm with its map, camera and mounting (`shell_localizer`).
        rate: how often new detections are looked for to count what was dropped, Hz; at least the
            camera's.

    Ports:
        detections (input, Detections): as for `Localizer`.
        pose (output, PoseEstimate): `X_RB` with covariance, of the latest picture; not `valid`
            (stamp NaN) when that shows no usable marker.
        alternative (output, PoseEstimate): the other minimum of the same picture, not `valid` when
            there is none.
        health (output, Health): markers left out, by reason.
        angles (output, vector of 3): [roll, pitch, yaw] (rad) of the pose; NaN without one.

    Source: [SNAIL] Algorithm 1, with the marker's rotation that its line 7 drops.
    """

    def __init__(self, *, localizer: MapLocalizer, rate: float) -> None:
        super().__init__(localizer=localizer, rate=rate)
        self._angles_output = self.DeclareVectorOutputPort(
            "angles", 3, self._calc_angles, {self.detections_input_port().ticket()}
        )

    def angles_output_port(self) -> OutputPort:
        """Returns the port of roll, pitch and yaw."""
        return self._angles_output

    def _calc_angles(self, context: Context, output: Any) -> None:
        pose = self.pose_output_port().Eval(context)
        known = angles_of(pose.pose.rotation().matrix()) if pose.valid else np.full(3, np.nan)
        output.SetFromVector(known)
