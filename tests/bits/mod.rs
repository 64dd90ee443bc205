//! Same bits, rows and draws, whatever else runs.

mod a_broken_state_ends_only_its_own_episode;
mod batch_composition_does_not_change_bits;
mod equal_numbers_are_kept_once;
mod padded_slots_change_nothing;
mod robots_that_run_away_stay_in_their_lane;
mod rows_cannot_be_confused;
mod same_seed_same_policy;
mod seeds_decide_the_draws;
mod shares_are_rows_of_the_whole;
mod snapshot_round_trip_is_exact;
mod thread_count_does_not_change_bits;
