"""Blender icons of our operators, for panel and menu. All exist in every version since 4.2."""

from __future__ import annotations

from ..access import Icon

OF: dict[str, Icon] = {
    "splannequin.add_light": "WORLD",
    "splannequin.add_splats": "OUTLINER_OB_POINTCLOUD",
    "splannequin.add_surface": "OUTLINER_OB_MESH",
    "splannequin.align_floor": "GRID",
    "splannequin.align_origin": "OBJECT_ORIGIN",
    "splannequin.align_scale": "ARROW_LEFTRIGHT",
    "splannequin.all_steps": "PLAY",
    "splannequin.bake": "RENDER_ANIMATION",
    "splannequin.cancel": "CANCEL",
    "splannequin.cancel_setup": "CANCEL",
    "splannequin.check_backend": "VIEWZOOM",
    "splannequin.check_move": "VIEWZOOM",
    "splannequin.clear_motion": "TRASH",
    "splannequin.combine_cg": "MESH_CUBE",
    "splannequin.combine_takes": "TIME",
    "splannequin.draw_matte": "MOD_MASK",
    "splannequin.export_cameras": "EXPORT",
    "splannequin.export_for_farm": "NETWORK_DRIVE",
    "splannequin.freeze": "FREEZE",
    "splannequin.import_clip": "IMPORT",
    "splannequin.freeze_as_warp": "MOD_WARP",
    "splannequin.insert_freeze": "NODE_COMPOSITING",
    "splannequin.insert_matte": "NODE_COMPOSITING",
    "splannequin.live": "HIDE_OFF",
    "splannequin.load_camera": "OUTLINER_OB_CAMERA",
    "splannequin.locate_shot": "FILE_FOLDER",
    "splannequin.matte_from_mask": "CLIPUV_DEHLT",
    "splannequin.motion_over_plate": "MOD_MASK",
    "splannequin.move_hold": "PAUSE",
    "splannequin.move_orbit": "ORIENTATION_GIMBAL",
    "splannequin.move_retime": "IPO_EASE_IN_OUT",
    "splannequin.move_smooth": "MOD_SMOOTH",
    "splannequin.open_log": "TEXT",
    "splannequin.paint_motion": "BRUSH_DATA",
    "splannequin.pick_run": "RESTRICT_SELECT_OFF",
    "splannequin.pick_take": "RESTRICT_SELECT_OFF",
    "splannequin.remove_backend": "TRASH",
    "splannequin.remove_light": "TRASH",
    "splannequin.remove_matte": "TRASH",
    "splannequin.remove_run": "TRASH",
    "splannequin.remove_shot": "TRASH",
    "splannequin.remove_take": "TRASH",
    "splannequin.render": "RENDER_ANIMATION",
    "splannequin.shot_add": "ADD",
    "splannequin.shot_remove": "REMOVE",
    "splannequin.save_motion": "FILE_TICK",
    "splannequin.set_up": "IMPORT",
    "splannequin.show_motion": "IMAGE_DATA",
    "splannequin.solve_camera": "CON_CAMERASOLVER",
    "splannequin.suggested_instant": "TRIA_RIGHT",
    "splannequin.t_star_here": "EYEDROPPER",
    "splannequin.t_star_marker": "MARKER",
    "splannequin.train": "POINTCLOUD_DATA",
    "splannequin.write_stmaps": "TEXTURE",
    "splannequin.use_clip": "FILE_MOVIE",
    "splannequin.use_movie_clip": "TRACKER",
}
"""Operator -> name of its icon."""


def of(operator: str) -> Icon:
    """Icon of an operator, or NONE."""
    return OF.get(operator, "NONE")
