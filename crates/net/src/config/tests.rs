//! Refused configs, and the messages of refusals.

use super::*;

const COMPLETED: &str = "[network]\nsides = \"completed\"\nbody = \"convolution\"\nanchor = \"ray\"\nmask_channel = true\n\
                         mirror = true\npatch = 8\n";
const GEOMETRIC: &str = "[regressor]\nstart = \"geometric\"\n";
const CLOSED: &str = "[network]\nclosed_top = true\n";

fn config(text: &str, overrides: &[&str]) -> Result<Config, String> {
    let overrides: Vec<String> = overrides.iter().map(|s| (*s).to_owned()).collect();
    Config::from_toml(text, "x.toml", &overrides).map_err(|e| e.to_string())
}

/// Completed sides need what they are made of. Limits of colours are shares of the range of corrected colours; limits
/// and least opacities belong to a geometric start. A closed top needs Gaussians without a regressor.
#[test]
fn impossible_values_and_combinations_name_the_keys() {
    for (text, set, key) in [
        ("", "network.enc_heads=7", "network.enc_heads"),
        ("", "network.net_resolution=500", "network.net_resolution"),
        ("", "network.hooks=[0, 6, 9, 13]", "network.hooks"),
        ("", "regressor.networks=3", "regressor.networks"),
        ("", "network.second_layer=true", "network.second_layer"),
        ("", "network.hull_reach=0.1", "network.hull_margin"),
        // The head of a transformer has patches of 16 pixels.
        (COMPLETED, "network.body=transformer", "network.patch"),
        (COMPLETED, "network.anchor=none", "network.anchor"),
        (COMPLETED, "network.mask_channel=false", "network.mask_channel"),
        (COMPLETED, "network.mirror=false", "network.mirror"),
        (COMPLETED, "network.patch=16", "network.patch"),
        (COMPLETED, "network.net_resolution=8", "network.net_resolution"),
        (COMPLETED, "network.side_dims=[0,1,1,1]", "network.side_dims"),
        (GEOMETRIC, "regressor.color_limits=[0,0.1]", "regressor.color_limits"),
        (GEOMETRIC, "regressor.color_limits=[0.1,1.5]", "regressor.color_limits"),
        (GEOMETRIC, "regressor.color_limits=[0.1,nan]", "regressor.color_limits"),
        ("", "regressor.color_limits=[0.1,0.1]", "regressor.start"),
        (GEOMETRIC, "regressor.least_opacities=[-0.1,0]", "regressor.least_opacities"),
        (GEOMETRIC, "regressor.least_opacities=[0,1.1]", "regressor.least_opacities"),
        (GEOMETRIC, "regressor.least_opacities=[nan,0]", "regressor.least_opacities"),
        ("", "regressor.least_opacities=[0.9,0.9]", "regressor.start"),
        (CLOSED, "regressor.start=published", "network.closed_top"),
        (CLOSED, "regressor.start=published", "regressor.start"),
    ] {
        let message = config(text, &[set]).expect_err(set);
        let is_named = message.contains(&format!("`{key}"));
        assert!(is_named && !message.contains("line"), "{set}: {message}");
    }
    let message = config(CLOSED, &["regressor.start=geometric", "mode.compat=true"]).expect_err("compat");
    assert!(message.contains("`network.closed_top`"), "{message}");
}
