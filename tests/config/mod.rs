//! Configs are read whole, or refused with file, key and remedy; files are written whole.

mod config_errors_name_file_key_and_remedy;
mod config_layers_and_names_resolve;
mod files_are_written_whole_or_not_at_all;
