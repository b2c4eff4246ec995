"""Source views: visibility of points in the clip's plates, moving pixels, reprojection, and operations on masks."""
