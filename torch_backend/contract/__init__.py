"""What crosses the wall between Blender and the backend. Standard library only: both sides read this package.

    errors          exit codes, and the failure that an artist reads
    options         what each step may be asked for
    jobs            a job's folder: request, status, events
    processes       children, and which process lives
    lock            one writer per shot
    shot_folder     where everything of a shot lies
    files, typed    reading what may come from anywhere, and plain JSON into dataclasses
    camera_path     a pinhole camera over frames
    live_messages   what Blender and a live session say to each other
    frame_layers    what the layers of a frozen frame hold
    results         verdicts and the figures of a run

Their public names are this package's own. Everything that is written carries a version; a newer one than ours is
refused in words.

Frames of reference, here as everywhere: camera axes OpenCV (x right, y down, z forward), `viewmat` world-to-camera,
row-major; `K` = (fx, fy, cx, cy) in pixels, pixel centres at +0.5; frame numbers are those of the clip.
"""

from .camera_path import (
    CameraFrame,
    CameraPath,
)
from .errors import (
    Cancelled,
    ExitCode,
    JobError,
)
from .files import (
    LONGEST_JSON,
    LONGEST_LINE,
    SHORT_JSON,
    checked_name,
    frame_file,
    frame_number,
    is_link,
    open_regular,
    printable,
    read_json,
    read_lines,
    remove_link,
)
from .frame_layers import (
    EXR_LAYERS,
    NO_DEPTH,
)
from .jobs import (
    CANCEL_FILE,
    EVENTS_FILE,
    HEARTBEAT_SECONDS,
    JOB_COMMAND,
    LOG_FILE,
    REQUEST_FILE,
    STATUS_FILE,
    STATUS_VERSION,
    WORK,
    Event,
    JobRequest,
    Reporter,
    Status,
    gone,
    runs_job,
)
from .live_messages import (
    LIVE_LIMIT,
    LIVE_SHOWS,
    LiveView,
    read_message,
    write_message,
)
from .lock import (
    WRITER_FILE,
    Writer,
    busy,
    gives_back,
    read_writer,
)
from .options import (
    DETECTORS,
    DEVICES,
    HOST_CONFIGS,
    HOSTS,
    LAST_FRAME,
    LIMITS,
    METHODS,
    PARAMS,
    PRESET_STEPS,
    PRESET_WIDTHS,
    SUPERVISIONS,
    SWITCH,
    FreezeParams,
    ImportParams,
    Limit,
    SolveParams,
    TrainParams,
    check_params,
    overscan,
)
from .processes import (
    GRACE_SECONDS,
    Process,
    end_with_starter,
    host_name,
    process,
    process_of_ps,
    process_start,
    program,
    python_child,
    runs_still,
)
from .results import (
    VERDICT_WORDS,
    Verdict,
    measured,
    summarise,
    verdict_lines,
    verdict_of,
)
from .shot_folder import (
    discard_unborn,
)
from .typed import (
    CONTRACT_VERSION,
    check_version,
    from_dict,
)

__all__ = [
    "CANCEL_FILE",
    "CONTRACT_VERSION",
    "DETECTORS",
    "DEVICES",
    "EVENTS_FILE",
    "EXR_LAYERS",
    "GRACE_SECONDS",
    "HEARTBEAT_SECONDS",
    "HOSTS",
    "HOST_CONFIGS",
    "JOB_COMMAND",
    "LAST_FRAME",
    "LIMITS",
    "LIVE_LIMIT",
    "LIVE_SHOWS",
    "LOG_FILE",
    "LONGEST_JSON",
    "LONGEST_LINE",
    "METHODS",
    "NO_DEPTH",
    "PARAMS",
    "PRESET_STEPS",
    "PRESET_WIDTHS",
    "REQUEST_FILE",
    "SHORT_JSON",
    "STATUS_FILE",
    "STATUS_VERSION",
    "SUPERVISIONS",
    "SWITCH",
    "VERDICT_WORDS",
    "WORK",
    "WRITER_FILE",
    "CameraFrame",
    "CameraPath",
    "Cancelled",
    "Event",
    "ExitCode",
    "FreezeParams",
    "ImportParams",
    "JobError",
    "JobRequest",
    "Limit",
    "LiveView",
    "Process",
    "Reporter",
    "SolveParams",
    "Status",
    "TrainParams",
    "Verdict",
    "Writer",
    "busy",
    "check_params",
    "check_version",
    "checked_name",
    "discard_unborn",
    "end_with_starter",
    "frame_file",
    "frame_number",
    "from_dict",
    "gives_back",
    "gone",
    "host_name",
    "is_link",
    "measured",
    "open_regular",
    "overscan",
    "printable",
    "process",
    "process_of_ps",
    "process_start",
    "program",
    "python_child",
    "read_json",
    "read_lines",
    "read_message",
    "read_writer",
    "remove_link",
    "runs_job",
    "runs_still",
    "summarise",
    "verdict_lines",
    "verdict_of",
    "write_message",
]
