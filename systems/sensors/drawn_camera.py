"""A camera whose pictures are drawn directly, without a renderer."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import FrameId, QueryObject, Rgba, Role, SceneGraphInspector, Sphere
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem, ValueProducer

from systems.cameras import PinholeCamera
from systems.drawing.boards import draw_board, marker_sheet, on_the_face
from systems.drawing.coverage import CoverageSheet
from systems.drawing.culling import BoundingBalls
from systems.drawing.layers import Drawing, paint
from systems.drawing.order import paint_order
from systems.drawing.shells import DrawnShell, draw_shell
from systems.drawing.solids import Polyhedron, draw_solid, polyhedron, view_planes
from systems.image_effects import ImageEffects
from systems.markers.family import Family
from systems.markers.projector import PlacedMarker
from systems.sensors.mounted_camera import Image, MountedCamera
from systems.validation import require, require_positive

Array = NDArray[np.float64]

# What Drake's renderer gives shapes without a colour of their own.
_DEFAULT_COLOUR = Rgba(0.9, 0.9, 0.9, 1.0)
_GREY = np.array([0.299, 0.587, 0.114])  # of red, green, blue (ITU-R BT.601), as in OpenCV


@dataclass
class DrawingParameters:
    """What is not said by the scene. Grey levels are shares of full white.

    Attributes:
        background: grey level where nothing is.
        paper: of marker boards in full light.
        ink: of marker boards in full light.
        shade: by how much a face that looks down is darker than one that looks up, 0 to 1.
        margin: white cells around a board's black square.
    """

    background: float = 0.8
    paper: float = 1.0
    ink: float = 0.03
    shade: float = 0.3
    margin: int = 1

    def __post_init__(self) -> None:
        for name in ("background", "paper", "ink", "shade"):
            value = getattr(self, name)
            require(0 <= value <= 1, name, value, "0 to 1")
        require(self.margin >= 1, "margin", self.margin, "at least 1 cell")

    def lit(self, upward: Array | float) -> Array:
        """Returns the share of full light on a face whose normal has that height, -1 to 1."""
        return 1 - self.shade * 0.5 * (1 - np.asarray(upward, float))


@dataclass(frozen=True, eq=False)
class _Solid:
    """A body of the scene: where it is fixed, and its colour (red, green, blue)."""

    body: Polyhedron
    frame: FrameId
    X_FS: Array
    colour: Array


class _Workshop:
    """What a Context keeps between pictures: the scene's solids, and memory. No state."""

    def __init__(self, solids: list[_Solid]) -> None:
        self.solids = solids
        self.balls = BoundingBalls(
            [solid.frame for solid in solids],
            [solid.body.vertices @ solid.X_FS[:, :3].T + solid.X_FS[:, 3] for solid in solids],
        )
        self.sheet = CoverageSheet()

    def __deepcopy__(self, memo: dict[int, Any]) -> _Workshop:
        return _Workshop(self.solids)


class DrawnCamera(MountedCamera):
    """Draws what a camera fixed to a body sees, then does what lens and sensor do to it.

    .. pydrake_system::

        name: DrawnCamera
        input_ports:
        - query_object
        - spatial_velocity
        - active
        output_ports:
        - image

    Every pixel holds the exact mean over its square of what is drawn, up to where edges of
    different objects cross in it. Distortion is drawn by the lens model, not by bending a picture.

    Args:
        camera: the calibrated camera.
        parent_frame: geometry frame of the body that carries the camera.
        X_PC: pose of the optical frame in the body.
        rate: pictures a second, Hz.
        markers: flat marker boards.
        family: of those markers; needed when there are any.
        shells: spheres with textures and markers of their own. A `Sphere` of the scene within one,
            fixed to the same frame, is left out.
        parameters: light and print.
        latency: from the middle of the exposure to arrival, s.
        clock_error: by how much the stamps are late on the clock of all others, s; at most the
            latency.
        effects: lens, exposure and noise. `supersampling` changes nothing: areas are exact.
        clipping: as of the rendered camera; only what is wholly farther than the second distance
            is left out, m.
        seed: of the noise, a parameter of the Context.
        name: of the noise stream.
        frame_id: of the optical frame, for the messages.
        solids: the role of the geometry that is drawn as plain solids; None for none.
        transparent_frames: frames whose geometry is not drawn.

    Ports:
        query_object (input, QueryObject): SceneGraph's `query`.
        spatial_velocity (input, vector of 6): of the body in W, rotation first (rad/s, m/s); needed
            only for motion blur (exposure_samples > 1).
        active (input, vector of 1): while it is 0 no pictures are taken; may be left unconnected.
        image (output, CameraImage): uint8 grey or RGB, at `rate`, `latency` after its stamp; a
            picture of size 0 with stamp NaN before the first.

    Pixels count from the centre of the first pixel (see `systems.cameras`). The world stands still
    during an exposure; the camera moves by its body's velocity. Meshes are drawn as their convex
    hulls, flat ones (printed faces) not at all: boards are drawn from `markers`. There are no
    shadows and no reflections.

    Raises:
        ValueError: rate, latency, clock error, clipping or seed out of range, markers without a
            family or of another one, or a distortion that cannot be inverted along the picture's
            border.
    """

    def __init__(
        self,
        *,
        camera: PinholeCamera,
        parent_frame: FrameId,
        X_PC: RigidTransform,
        rate: float,
        markers: Sequence[PlacedMarker] = (),
        family: Family | None = None,
        shells: Sequence[DrawnShell] = (),
        parameters: DrawingParameters | None = None,
        latency: float = 0.0,
        clock_error: float = 0.0,
        effects: ImageEffects | None = None,
        clipping: tuple[float, float] = (0.01, 50.0),
        seed: int = 0,
        name: str = "camera",
        frame_id: str = "camera",
        solids: Role | None = Role.kPerception,
        transparent_frames: Collection[FrameId] = (),
    ) -> None:
        super().__init__(
            parent_frame=parent_frame,
            X_PC=X_PC,
            rate=rate,
            latency=latency,
            clock_error=clock_error,
            effects=effects,
            clipping=clipping,
            seed=seed,
            name=name,
            frame_id=frame_id,
        )
        require(not markers or family is not None, "family", family, "that of the markers")
        for marker in markers:
            assert family is not None
            family.check_id(marker.id)
            require_positive(**{f"size of marker {marker.id}": marker.size})
        require(
            bool(np.isfinite(view_planes(camera)).all()),
            "D",
            camera.D.tolist(),
            "invertible along the picture's border",
        )
        self._camera = camera
        self._far = clipping[1]
        self._shells = tuple(shells)
        self._parameters = parameters or DrawingParameters()
        self._role = solids
        self._transparent = frozenset(transparent_frames)
        margin = self._parameters.margin
        self._boards = [(m, marker_sheet(family, m.id, margin)) for m in markers if family]
        corners = [
            on_the_face(sheet.start, m.size, m.X_FM.GetAsMatrix34()) for m, sheet in self._boards
        ]
        self._board_balls = BoundingBalls([m.frame for m, _ in self._boards], corners)
        no_calc: Any = ValueProducer.NoopCalc
        self._workshop_entry = self.DeclareCacheEntry(
            "solids of the scene, and memory",
            ValueProducer(allocate=lambda: AbstractValue.Make([]), calc=no_calc),
            {LeafSystem.nothing_ticket()},
        )

    def _picture(self, context: Context, query: QueryObject, poses: list[RigidTransform]) -> Image:
        X_WP = query.GetPoseInWorld(self._parent)
        workshop = self._workshop(context, query)
        total = self._draw(query, X_WP @ poses[0], workshop)
        for X_PC in poses[1:]:
            total += self._draw(query, X_WP @ X_PC, workshop)
        if len(poses) > 1:
            total /= len(poses)
        total += 0.5  # to the nearest: the cast cuts off
        image: Image = np.clip(total, 0.0, 255.0, out=total).astype(np.uint8)
        return image[:, :, 0] if self._effects.grey else image

    def _draw(
        self, query: QueryObject, X_WC: RigidTransform, workshop: _Workshop
    ) -> NDArray[np.float32]:
        """Returns the picture (height, width, channels), not rounded."""
        camera, p = self._camera, self._parameters
        channels = 1 if self._effects.grey else 3
        X_CW = X_WC.inverse().GetAsMatrix34()
        up = X_CW[:, 2]
        frames = {*self._board_balls.frames, *workshop.balls.frames}
        poses = {frame: _compose(X_CW, query.GetPoseInWorld(frame)) for frame in frames}
        drawings: list[Drawing | None] = []
        for k in self._board_balls.in_view(camera, poses):
            marker, sheet = self._boards[k]
            X_CM = _compose(poses[marker.frame], marker.X_FM)
            lit = 255 * float(p.lit(float(up @ X_CM[:, 0])))
            drawings.append(
                draw_board(camera, X_CM, marker.size, sheet, lit * p.paper, lit * p.ink)
            )
        for shell in self._shells:
            X_CS = _compose(X_CW, query.GetPoseInWorld(shell.frame) @ shell.X_FS)
            drawings.append(draw_shell(camera, shell, X_CS, channels))
        for k in workshop.balls.in_view(camera, poses):
            solid = workshop.solids[k]
            X_CF = poses[solid.frame]
            X_CS = np.column_stack(
                [X_CF[:, :3] @ solid.X_FS[:, :3], X_CF[:, :3] @ solid.X_FS[:, 3] + X_CF[:, 3]]
            )
            colour = solid.colour if channels == 3 else solid.colour[:3] @ _GREY[:, None]
            lights = 255 * p.lit(solid.body.normals @ X_CS[:, :3].T @ up)
            drawings.append(draw_solid(camera, solid.body, X_CS, np.outer(lights, colour)))
        seen = [
            drawing
            for drawing in drawings
            if drawing is not None
            and np.linalg.norm(drawing.points, axis=1).min() - drawing.radius < self._far
        ]
        picture = np.full((camera.height, camera.width, channels), 255 * p.background, np.float32)
        paint(picture, [seen[k] for k in paint_order(seen)], workshop.sheet)
        return picture

    def _workshop(self, context: Context, query: QueryObject) -> _Workshop:
        slot: Any = self._workshop_entry.get_mutable_cache_entry_value(context)
        slot = slot.GetMutableValueOrThrow()
        if not slot:
            slot.append(_Workshop(self._solids_of(query.inspector())))
        workshop: _Workshop = slot[0]
        return workshop

    def _solids_of(self, inspector: SceneGraphInspector) -> list[_Solid]:
        """Returns the scene's solids; the shapes are looked at once a Context."""
        if self._role is None:
            return []
        solids = []
        for geometry in inspector.GetAllGeometryIds(self._role):
            frame, shape = inspector.GetFrameId(geometry), inspector.GetShape(geometry)
            X_FS = inspector.GetPoseInFrame(geometry)
            if frame in self._transparent or self._is_shell(frame, shape, X_FS):
                continue
            body = polyhedron(shape)
            if body is None:
                continue
            properties = inspector.GetProperties(geometry, self._role)
            rgba = properties.GetPropertyOrDefault("phong", "diffuse", _DEFAULT_COLOUR)
            colour = np.array([rgba.r(), rgba.g(), rgba.b()])
            if rgba.a() > 0:
                solids.append(_Solid(body, frame, X_FS.GetAsMatrix34(), colour))
        return solids

    def _is_shell(self, frame: FrameId, shape: Any, X_FS: RigidTransform) -> bool:
        if not isinstance(shape, Sphere):
            return False
        return any(
            frame == shell.frame
            and np.linalg.norm(X_FS.translation() - shell.X_FS.translation()) + shape.radius()
            <= shell.radius * (1 + 1e-6)
            for shell in self._shells
        )


def _compose(X_AB: Array, X_BC: RigidTransform) -> Array:
    """Returns X_AC as (3, 4)."""
    X = X_BC.GetAsMatrix34()
    moved = X_AB[:, :3] @ X
    moved[:, 3] += X_AB[:, 3]
    return np.asarray(moved)
