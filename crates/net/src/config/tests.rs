//! Accepted configs, refused configs, and the messages of refusals.

use super::*;

fn refusal(text: &str, overrides: &[&str]) -> String {
    let overrides: Vec<String> = overrides.iter().map(|s| (*s).to_owned()).collect();
    Config::from_toml(text, "x.toml", &overrides).expect_err("refused").to_string()
}

#[test]
fn impossible_sizes_name_the_key() {
    assert!(refusal("[network]\nenc_heads = 7\n", &[]).contains("network.enc_heads"));
    assert!(refusal("[network]\nnet_resolution = 500\n", &[]).contains("network.net_resolution"));
    assert!(refusal("[network]\nhooks = [0, 6, 9, 13]\n", &[]).contains("network.hooks"));
    assert!(refusal("[regressor]\nnetworks = 3\n", &[]).contains("regressor.networks"));
}

#[test]
fn completed_sides_need_what_they_are_made_of() {
    let lines = "[network]\nsides = \"completed\"\nbody = \"convolution\"\nanchor = \"ray\"\nmask_channel = true\nmirror = true\n\
                 patch = 8\n";
    Config::from_toml(lines, "x", &[]).expect("valid");
    for (set, key) in [
        ("network.body=transformer", "network.body"),
        ("network.anchor=none", "network.anchor"),
        ("network.mask_channel=false", "network.mask_channel"),
        ("network.mirror=false", "network.mirror"),
        ("network.patch=16", "network.patch"),
        ("network.net_resolution=8", "network.net_resolution"),
        ("network.side_dims=[0,1,1,1]", "network.side_dims"),
    ] {
        let message = refusal(lines, &[set]);
        assert!(message.contains(key) && !message.contains("line"), "{set}: {message}");
    }
    assert!(refusal("", &["network.second_layer=true"]).contains("network.second_layer"));
}

#[test]
fn limits_of_colours_are_shares_of_the_range_of_corrected_colours() {
    let geometric = "[regressor]\nstart = \"geometric\"\n";
    let set = |limits: &str| format!("regressor.color_limits={limits}");
    let config = Config::from_toml(geometric, "x", &[set("[0.03,0.1]")]).expect("valid");
    assert_eq!(config.regressor.color_limits, [0.03, 0.1]);
    for limits in ["[0,0.1]", "[0.1,1.5]", "[0.1,nan]"] {
        assert!(refusal(geometric, &[&set(limits)]).contains("regressor.color_limits"), "{limits}");
    }
    assert!(refusal("", &[&set("[0.1,0.1]")]).contains("regressor.start"));
}

#[test]
fn least_opacities_are_those_of_a_geometric_start() {
    let geometric = "[regressor]\nstart = \"geometric\"\n";
    let set = |least: &str| format!("regressor.least_opacities={least}");
    let config = Config::from_toml(geometric, "x", &[set("[0.95,0]")]).expect("valid");
    assert_eq!(config.regressor.least_opacities, [0.95, 0.0]);
    for least in ["[-0.1,0]", "[0,1.1]", "[nan,0]"] {
        assert!(refusal(geometric, &[&set(least)]).contains("regressor.least_opacities"), "{least}");
    }
    assert!(refusal("", &[&set("[0.9,0.9]")]).contains("regressor.start"));
}

#[test]
fn a_closed_top_needs_gaussians_without_a_regressor() {
    let closed = "[network]\nclosed_top = true\n";
    assert!(Config::from_toml(closed, "x", &["regressor.start=geometric".to_owned()]).is_ok());
    let message = refusal(closed, &[]);
    assert!(message.contains("network.closed_top") && message.contains("regressor.start"), "{message}");
    let message = refusal(closed, &["regressor.start=geometric", "mode.compat=true"]);
    assert!(message.contains("network.closed_top"), "{message}");
}

#[test]
fn the_reach_of_the_silhouettes_is_in_force_with_their_margin() {
    for (set, reach) in [
        (&[][..], 0.0),
        (&["network.hull_margin=8"], 0.05),
        (&["network.hull_margin=8", "network.hull_reach=0"], 0.0),
    ] {
        let set: Vec<String> = set.iter().map(|s| (*s).to_owned()).collect();
        let config = Config::from_toml("", "x", &set).expect("valid");
        assert_eq!(config.network.hull_reach(), reach, "{set:?}");
    }
    assert!(refusal("", &["network.hull_reach=0.1"]).contains("without `network.hull_margin`"));
}
