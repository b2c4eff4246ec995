"""Interface between Blender and the backend. Standard library only, because both sides import this package.

    errors          exit codes, and errors with messages for artists
    options         parameters of each step (train_options, take_options; option_choices): option_table makes panel and
                    reference from them
    verbs           verbs of the command lines; command_line makes both parsers from them
    jobs            a job's folder: request, status, events
    processes       starting child processes, and checking which process lives
    pace            how long jobs take on this machine
    lock            one writer per shot
    path_rules      paths of another computer mapped to this one
    shot_folder     paths in a shot folder
    shot_work       work in a shot that depends on its present frames
    clip_shot       the shot folder of a clip
    unborn          what a failed import leaves behind
    files, typed    reading files from anywhere, and plain JSON into dataclasses
    identity        identity of a file by its content
    picture_files   whether a picture, a movie or a .blend is whole
    writing         atomic files and folders
    camera_path     a pinhole camera over frames
    placement       transform of a solve into Blender's scene
    ply_header      the header of a file of splats
    surface_header  the header of a file of a take's surface
    light_facts     facts of a panorama of a take's light
    live_messages   messages between Blender and a live session
    colour          a probe colour that identifies a colour space, and the display of light
    frame_names     frame numbers in file names
    timecode        SMPTE timecode: the footage's start, and the code of each frame after it
    frame_layers    content of the layers of a frozen frame
    checkpoint_header   facts in the header of a checkpoint
    torch_source    the PyTorch build that a set-up installs
    installed       what a set-up installed, and whether it is unchanged
    results         verdicts and the figures of a run

This package re-exports the public names of these modules. Every file that is written has a version. A file with a newer
version is refused with a message.

Frames of reference, throughout the project: camera axes OpenCV (x right, y down, z forward), `viewmat` world-to-camera,
row-major; `K` = (fx, fy, cx, cy) in pixels, pixel centres at +0.5; frame numbers are those of the clip.
"""

# pyright: reportUnusedImport=false
# Other modules import every name below from this package.

from .camera_path import CAMERA_FACTS_KEY, SCENE_WORLD, CameraFrame, CameraPath
from .checkpoint_header import checkpoint_facts
from .clip_shot import check_same_clip, collision_key, default_shot_folder, is_imported_from, path_digest, readable_stem
from .colour import PROBE, SHOULDER, SHOULDER_FROM, SHOULDER_ROLL
from .command_line import (
    arguments_of,
    as_json,
    command_line,
    freezes_a_shot,
    is_shot,
    notes,
    options_for,
    requested_params,
    trains_anew,
    words_of,
)
from .errors import (
    Cancelled,
    ExitCode,
    JobError,
    MissingError,
    UnreadableFile,
    UserError,
    broke,
    disk_error,
    incomplete,
    is_disk_full,
    path_error,
    unexpected,
)
from .files import (
    LONGEST_ARRAYS,
    LONGEST_CHECKPOINT,
    LONGEST_JSON,
    LONGEST_LINE,
    LONGEST_PICTURE,
    MOST_PIXELS,
    SHORT_JSON,
    checked_name,
    frame_file,
    frame_number,
    is_link,
    open_arrays,
    open_regular,
    png_size,
    printable,
    read_json,
    read_lines,
    regular_file,
    remove_link,
)
from .frame_layers import CRYPTOMATTE, FRAME_LAYERS, MATTE_LAYERS, NO_DEPTH, FrameLayer, channels_of, layers_of
from .frame_names import NumberedFiles, ending, file_as_blender_counts, is_pattern, matching_files, numbered_files
from .hosts import host_names
from .identity import file_digest, files_digest
from .installed import (
    SETUP_BEGUN,
    SETUP_NOTES,
    SETUP_STAMP,
    changed_packages,
    changed_since_set_up,
    package_name,
    record_packages,
    site_packages,
)
from .jobs import (
    BLEND_FILE,
    CAMERAS_KNOWN,
    CANCEL_FILE,
    EVENTS_FILE,
    FORECAST,
    HEARTBEAT_SECONDS,
    JOB_COMMAND,
    LOG_FILE,
    REQUEST_FILE,
    SCENE_FILE,
    STATUS_FILE,
    STATUS_VERSION,
    STEP_FILE,
    WORK,
    Event,
    JobRequest,
    Reporter,
    Status,
    missing_shot_error,
    new_job,
    runs_job,
)
from .light_facts import LightFacts, light_of_take, point_of
from .live_messages import LIVE_LIMIT, LIVE_SHOWS, LiveView, read_message, write_message
from .lock import Writer, busy, is_ending, read_writer
from .option_choices import (
    CAMERA_MODELS,
    CARD_GAUSSIANS,
    CARD_WIDTH,
    DETECTORS,
    DEVICES,
    HOST_CONFIGS,
    HOSTS,
    LAST_FRAME,
    MATTE_FORMATS,
    METHODS,
    PRESET_STEPS,
    PRESET_WIDTHS,
    QUERIES,
    ST_MAP_WAYS,
    SUPERVISIONS,
)
from .option_table import (
    MASK_ALPHA,
    MASK_FOUND,
    SWITCH,
    Limit,
    Option,
    default_of,
    limits_of,
    option,
    options_of,
    overscan,
    panel,
)
from .options import (
    LIMITS,
    PARAMS,
    STEP_PARAMS,
    ImportParams,
    SolveParams,
    check_params,
)
from .pace import (
    BEGINS_WITH,
    LASTING_STAGES,
    ShotSize,
    TotalProgress,
    duration,
    expected_seconds,
    learn_pace,
    paces,
)
from .path_rules import RULES_VARIABLE, mapped
from .picture_files import is_whole_picture, read_exr_header
from .placement import Placement, placement_of
from .ply_header import read_ply_header
from .processes import (
    GRACE_SECONDS,
    Process,
    child_environment,
    commands_of_ps,
    computer_name,
    detach_standard_input,
    end_with_starter,
    memory,
    process,
    process_of_ps,
    process_start,
    program,
    python_child,
    run_from,
    runs_still,
)
from .results import (
    DEPTH_KINDS,
    VERDICT_WORDS,
    Verdict,
    depth_line,
    measured,
    summarise,
    take_figures,
    verdict_lines,
    verdict_of,
)
from .shot_folder import (
    BURNT_IN_FILE,
    CAMERAS_FILE,
    CHECKPOINT_FILE,
    COLMAP_FOLDER,
    COLMAP_LOG,
    CONFIG_FILE,
    DEPTH_FILE,
    DEVELOPED_FOLDER,
    DRAWN_FOLDER,
    EXTENSION_FILE,
    FRAMES_FILE,
    FRAMES_FOLDER,
    INFO_FILE,
    JOBS_FOLDER,
    LAYERS,
    LIVE_LOG,
    MASK_KINDS,
    METRICS_FILE,
    MOTION_FILE,
    MOTION_FOLDER,
    MOTION_UNFINISHED_FILE,
    NEXT_FOLDER,
    PAINTED_FOLDER,
    PICTURE,
    PLY_FILE,
    POINTS_FILE,
    PREVIEWS_FOLDER,
    RAW_FOLDER,
    RUNS_FOLDER,
    SHOT_SUFFIX,
    SOLVE_FILE,
    SOLVE_FOLDER,
    STMAP_FILES,
    SUMMARY_FILE,
    SURFACE,
    SURFACE_FILE,
    TAKE_FILE,
    TAKE_UNDISTORT,
    TAKES_FOLDER,
    UNPUBLISHED_FILE,
    USD_FILE,
    WRITER_FILE,
    RunFolder,
    ShotFolder,
    TakeFolder,
)
from .shot_work import FOLDERS_OF_FRAMES, work_words
from .surface_header import TRIANGLE_FIELDS, VERTEX_FIELDS, SurfaceHeader, read_surface_header, surface_of_take
from .take_options import LIVE_SOURCE, CombineParams, FreezeParams, LightParams, MatteParams, SurfaceParams
from .timecode import later, parse_timecode
from .torch_source import CPU_INDEX, CUDA_INDEX, TORCH_INDEX, brings_cuda, torch_index
from .train_options import TrainParams
from .typed import CONTRACT_VERSION, check_version, from_dict
from .unborn import discard_unborn, refuse_foreign
from .verbs import BACKEND, BLENDER, COMMANDS, INPUT, VERBS, ExportWords, FarmWords, Verb
from .writing import (
    atomic_path,
    content_key,
    disk_time,
    is_half_written,
    locked,
    make_folder,
    need_disk,
    remove_file,
    replace_file,
    replaced_folder,
    replacing_folder,
    restore_folder,
    sweep_half_written,
    try_lock,
    working_on,
    write_atomic,
    write_json,
)
