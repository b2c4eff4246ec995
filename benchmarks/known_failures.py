"""Known failures of other programs, of rasterisers and of training, and the tests that stand for them here."""

_H, _P = "test_hard_cases.py::", "test_properties.py::"
ROWS: list[tuple[str, list[str], str]] = [
    (
        "NaN loss, everything dies in 1 to 2 steps",
        [
            _H + "test_non_finite_gaussian_is_culled_and_the_others_stay",
            _H + "test_non_finite_harmonics_are_culled",
            _P + "test_any_numbers_give_sane_images_and_gradients",
        ],
        "skipping a step whose loss is not finite is the trainer's",
    ),
    (
        "NaN hidden by culling; ratio of determinants underflows",
        [
            _H + "test_poisoned_gaussians_show_in_their_radii_though_not_in_the_image",
            _H + "test_a_point_keeps_half_a_percent_of_its_opacity_when_antialiased",
        ],
        "",
    ),
    ("NaN spreads in squares", [_H + "test_ssim_sees_no_nan_of_a_poisoned_scene"], ""),
    (
        "Inf scale, NaN radius, uninitialised keys",
        [
            _H + "test_infinite_and_enormous_scales_are_culled",
            _H + "test_extreme_scales",
            _H + "test_what_overflows_and_is_culled_gets_zero_gradients",
            _H + "test_a_tall_image_needs_more_tile_spans_than_are_kept",
        ],
        "same predicate when counting and emitting",
    ),
    (
        "Near plane",
        [
            _H + "test_near_plane",
            _H + "test_gaussian_on_the_near_plane_is_culled",
            _H + "test_scale_of_the_world_does_not_matter",
        ],
        "which near plane suits a scene is the trainer's",
    ),
    (
        "Frustum-edge Jacobian blow-up",
        [
            _H + "test_frustum_edge_jacobian_is_clamped_about_the_principal_point",
            _H + "test_footprint_beyond_the_frustum_is_bounded_by_the_clamp",
            _H + "test_no_gradient_passes_the_frustum_clamp",
            _H + "test_principal_point_off_centre_and_outside",
            _H + "test_a_crop_with_the_principal_point_aside_is_the_crop_of_the_image",
            _P + "test_footprints_at_the_frustum_edge_are_bounded",
        ],
        "the clamp still turns long splats beyond the edge; their size is bounded",
    ),
    (
        "Degenerate 2D covariance",
        [
            _H + "test_a_point_is_as_wide_as_the_low_pass",
            _H + "test_degenerate_covariances",
            _H + "test_long_thin_gaussians_keep_their_precision",
            _H + "test_a_point_keeps_half_a_percent_of_its_opacity_when_antialiased",
        ],
        "",
    ),
    (
        "Zero or non-unit quaternion",
        [_H + "test_zero_quaternion_is_culled", _H + "test_length_of_a_quaternion_does_not_matter"],
        "",
    ),
    (
        "Zero scale, log-scale explosion",
        [
            _H + "test_extreme_scales",
            _H + "test_infinite_and_enormous_scales_are_culled",
            _H + "test_a_point_is_as_wide_as_the_low_pass",
        ],
        "pruning by size is the trainer's",
    ),
    (
        "Alpha clamp and saturated opacity",
        [
            _H + "test_opacity_at_its_ends",
            _H + "test_no_gradient_passes_the_alpha_clamp",
            _H + "test_pixel_stops_once_it_is_opaque",
        ],
        "",
    ),
    (
        "Opacity reset kills Gaussians",
        [_H + "test_faint_gaussians_lose_their_gradient_where_they_can_be_counted"],
        "the rasteriser's part: such Gaussians have no radius and no weight, so they can be counted",
    ),
    (
        "Hard 1/255 cut-off breaks gradcheck",
        ["test_reference.py::test_gradients_are_those_of_finite_differences"],
        "a scene kept clear of the cut-offs",
    ),
    (
        "SH clamp at 0 traps black Gaussians",
        [_H + "test_black_harmonics_can_become_brighter_but_not_darker", _H + "test_colours_have_no_ceiling"],
        "",
    ),
    (
        "Huge screen radius",
        [
            _H + "test_opaque_gaussians_reach_beyond_three_sigma",
            _H + "test_one_gaussian_over_all_pixels",
            _H + "test_one_gaussian_over_millions_of_pixels_takes_memory_by_the_pixel",
            _H + "test_ten_thousand_gaussians_in_one_pixel",
            _H + "test_ten_thousand_gaussians_in_one_pixel_take_memory_by_the_gaussian",
        ],
        "",
    ),
    (
        "Tile-key overflow",
        [
            _H + "test_more_hits_than_an_index_holds_are_refused_before_memory_is_taken",
            _H + "test_images_wider_than_a_tile_column_can_say_are_refused",
        ],
        "",
    ),
    (
        "Empty frustum, zero Gaussians",
        [_H + "test_no_gaussians", _H + "test_nothing_in_view", _H + "test_no_cameras"],
        "",
    ),
    (
        "More than 2^24 samples",
        [_H + "test_one_gaussian_over_millions_of_pixels_takes_memory_by_the_pixel"],
        "the rasteriser's part: sums over more pixels than float32 can count",
    ),
    (
        "SSIM",
        [
            _H + "test_images_smaller_than_the_window_of_ssim_are_compared_by_l1_alone",
            _H + "test_ssim_takes_one_as_the_range_of_the_data",
            "test_ssim.py::test_refuses_what_it_cannot_do",
        ],
        "",
    ),
    (
        "Wrong poses or scene scale",
        [_H + "test_scale_of_the_world_does_not_matter", _P + "test_scaling_the_world_scales_the_depth"],
        "the rasteriser's part: a world of any scale renders the same",
    ),
]
"""Rows of the list of known failures that concern rendering: (row, tests, remark)."""
_S, _D, _T = "train/test_stability.py::", "deformation/", "train/"
TRAINING: list[tuple[str, list[str], str]] = [
    (
        "NaN loss, everything dies in 1 to 2 steps",
        [
            _S + "test_one_bad_number_is_named_and_the_run_goes_on",
            _S + "test_a_gradient_of_its_own_costs_a_gaussian_and_no_more",
            _S + "test_too_much_to_repair_ends_in_words",
            _T + "test_adam.py::test_a_step_that_is_not_finite_changes_nothing",
            _T + "test_train.py::test_a_run_that_keeps_failing_ends_in_words",
        ],
        "the step is left out, the offender dropped or mended and named; no restart",
    ),
    (
        "NaN hidden by culling",
        [
            _S + "test_one_bad_number_is_named_and_the_run_goes_on",
            _S + "test_what_was_in_order_stays_as_it_was_row_by_row",
            "gaussians/test_model.py::test_budget_is_never_exceeded_and_nan_is_pruned",
        ],
        "parameters and moments are looked over every 10 steps, whatever the loss says",
    ),
    (
        "NaN spreads in squares",
        [
            _S + "test_a_frame_with_bad_pixels_is_left_out_from_then_on",
            _S + "test_a_bad_frame_does_not_keep_the_gate_shut",
        ],
        "from an image",
    ),
    (
        "Zero scale, log-scale explosion",
        [_T + "test_adam.py::test_range_is_kept", _S + "test_a_gaussian_too_large_for_its_place_is_dropped"],
        "",
    ),
    ("Opacity reset kills Gaussians", [], "opacities are never reset"),
    ("More than 2^24 samples", [], "nothing is drawn by `torch.multinomial`"),
    (
        "Wrong poses or scene scale",
        [
            "test_scene.py::test_normalisation_keeps_every_pixel_and_leads_back",
            "test_scene.py::test_a_camera_that_stands_still_is_refused",
            "solve/test_points.py::test_points_are_filtered",
            "solve/test_solving.py::test_models_that_nothing_could_be_trained_on_are_refused",
        ],
        "",
    ),
    (
        "Divergence without NaN",
        [
            _S + "test_a_field_that_throws_gaussians_out_of_their_place_is_put_back",
            _S + "test_a_hasty_step_of_one_attribute_is_trained_away",
            _S + "test_whole_runs_of_every_host_stay_finite_and_alike",
        ],
        'docs/benchmarks.md, "Stability"',
    ),
    ("Floaters in front of the camera", [], "no remedy of its own and no test; held-out views are shown"),
    ("Exposure drift", [_T + "test_exposure.py::test_finds_a_drift"], "fitted from the first step, before the gate"),
    ("Rolling shutter", [], "neither detected nor tested; there is a synthetic scene to measure it on"),
    ("Moving shadows, light", [], "no test; there is a synthetic scene to measure them on"),
    ("Time-plane half range", [_D + "test_hexplane.py::test_ends_of_time_hit_the_end_nodes"], ""),
    (
        "HexPlane out of bounds",
        [
            _D + "test_planes.py::test_the_published_lookup_pulls_points_as_float64_does",
            _D + "test_planes.py::test_a_gaussian_at_nan_stays_inside_the_planes",
        ],
        "the rim's feature holds, and pulls nobody; the box is that of the Gaussians that open, and a margin",
    ),
    (
        "Single or duplicate timestamps",
        [
            _D + "test_planes.py::test_planes_of_two_nodes_do_not_bend",
            "supervision/test_supervision.py::test_paper_needs_a_well_supervised_reference_and_two_times",
        ],
        "with one pose the camera stands still: refused (`test_scene.py`)",
    ),
    (
        "ARAP SVD",
        [
            _D + "test_geometry.py::test_collapsed_flat_and_bad_edges",
            _D + "test_control_points.py::test_penalties_are_finite_at_collapsed_nodes",
            _S + "test_control_points_on_one_spot_stay_finite",
        ],
        "",
    ),
    (
        "6-DoF rotation of angle 0",
        [
            _D + "test_geometry.py::test_screw_has_gradients_at_angle_zero",
            _D + "test_mlp.py::test_six_dof_is_still_at_the_start_and_has_gradients_there",
        ],
        "",
    ),
]
"""Rows that concern training: (row, tests in tests/backend, remark)."""
