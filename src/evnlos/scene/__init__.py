"""What is hidden and how it moves."""

from evnlos.scene.databases import Handwritten, list_emnist, list_sd19, read_emnist, read_sd19
from evnlos.scene.drawings import drawing
from evnlos.scene.fonts import (
    DIGITS,
    UPPER_CASE,
    Font,
    character_name,
    find_font,
    fit_to_target_plane,
    render_glyph,
)
from evnlos.scene.glyph_sets import (
    DrawingGlyphs,
    EmnistGlyphs,
    FontGlyphs,
    Glyphs,
    GlyphSet,
    HandwritingGlyphs,
    NistGlyphs,
    ObjectId,
    TargetPlane,
)
from evnlos.scene.handwriting import (
    TRAIN_WRITERS,
    Hand,
    Strokes,
    hand,
    held_out_writers,
    nist_like,
    pen_width,
    redrawn,
)
from evnlos.scene.moving import LineMotion, Motion, PathMotion, Pose, Scene, Target

__all__ = [
    "DIGITS",
    "TRAIN_WRITERS",
    "UPPER_CASE",
    "DrawingGlyphs",
    "EmnistGlyphs",
    "Font",
    "FontGlyphs",
    "GlyphSet",
    "Glyphs",
    "Hand",
    "HandwritingGlyphs",
    "Handwritten",
    "LineMotion",
    "Motion",
    "NistGlyphs",
    "ObjectId",
    "PathMotion",
    "Pose",
    "Scene",
    "Strokes",
    "Target",
    "TargetPlane",
    "character_name",
    "drawing",
    "find_font",
    "fit_to_target_plane",
    "hand",
    "held_out_writers",
    "list_emnist",
    "list_sd19",
    "nist_like",
    "pen_width",
    "read_emnist",
    "read_sd19",
    "redrawn",
    "render_glyph",
]
