//! Bodies move as mechanics says.

mod candidates_inside_a_foot_are_left_out;
mod contact_fuzz;
mod dry_friction_holds_what_is_at_rest;
mod dynamics_identities;
mod energy_drift_has_the_expected_order;
mod external_wrenches_move_the_base;
mod friction_resists_turning_and_rolling;
mod gravity_is_one_quantity;
mod jammed_links_do_not_sink;
mod joint_limits_hold_under_full_effort;
mod momentum_is_conserved_in_free_flight;
mod normal_forces_mean_the_same;
mod self_collision_keeps_links_apart;
mod springs_and_surfaces_act;
