//! Invariants of the splatting operation for every scene, and its behaviour on extreme input.

use burn::tensor::{Device, Tensor};
use snapsnap_splat::{Camera, Counts, Gaussians, MAX_SIDE, RenderOptions, SplatError, render};
use snapsnap_tests::scenes::{HostScene, Pass, Random, forward_camera, random_scene, random_upstream};
use snapsnap_tests::{device, device_name, is_on_gpu, values};

const NOT_FINITE: [f32; 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];

fn pass(host: &HostScene, cameras: &[Camera], options: &RenderOptions, device: &Device) -> Pass {
    let pixels = cameras.iter().map(|c| (c.width * c.height) as usize).sum();
    host.pass(cameras, options, &random_upstream(pixels, 5), device)
}

/// Equal bit by bit, a NaN included.
fn same_bits(a: &Pass, b: &Pass) -> bool {
    let bits = |pass: &Pass| -> Vec<u32> {
        let all = pass.image.iter().chain(pass.gradient.iter().flatten()).chain(&pass.background);
        all.map(|v| v.to_bits()).collect()
    };
    bits(a) == bits(b)
}

#[test]
fn two_runs_give_the_same_bits() {
    let Some(device) = device() else { return };
    for antialiased in [false, true] {
        let options = RenderOptions { antialiased, ..RenderOptions::inria() };
        let host = random_scene(400, 3);
        let cameras = [forward_camera(97, 65), forward_camera(97, 65)];
        // Multiplications and sums outside the operation are tuned on the first run and may change with it.
        pass(&host, &cameras, &options, &device);
        let first = pass(&host, &cameras, &options, &device);
        for _ in 0..3 {
            assert!(same_bits(&first, &pass(&host, &cameras, &options, &device)));
        }
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let Some(device) = device().filter(|_| !is_on_gpu()) else { return };
    let (host, cameras) = (random_scene(6000, 2), [forward_camera(150, 130); 2]);
    let options = RenderOptions { antialiased: true, ..RenderOptions::inria() };
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| pass(&host, &cameras, &options, &device))
    };
    let one = with(1);
    assert!([2, 5].into_iter().all(|threads| same_bits(&one, &with(threads))));
}

#[test]
fn the_order_of_gaussians_does_not_matter() {
    let Some(device) = device() else { return };
    let host = random_scene(60, 4);
    let (camera, options) = ([forward_camera(50, 37)], RenderOptions::inria());
    let mut turned = host.clone();
    turned.gaussians.reverse();
    turned.gaussians.rotate_left(17);
    let (a, mut b) = (pass(&host, &camera, &options, &device), pass(&turned, &camera, &options, &device));
    b.gradient.rotate_right(17);
    b.gradient.reverse();
    assert!(same_bits(&a, &b));
}

/// Equal depths: the earlier Gaussian is in front.
#[test]
fn ties_are_broken_by_the_index() {
    let Some(device) = device() else { return };
    let gaussian = |red: f32| [0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.1, 0.9, red, 0.0, 0.0];
    let camera = [forward_camera(16, 16)];
    let red_at_centre = |reds: [f32; 3]| {
        let host = HostScene { gaussians: reds.map(gaussian).to_vec(), background: [0.0; 3] };
        let image = pass(&host, &camera, &RenderOptions::inria(), &device).image;
        image[5 * (8 * 16 + 8)]
    };
    let first = red_at_centre([1.0, 0.0, 0.0]);
    let second = red_at_centre([0.0, 1.0, 0.0]);
    let third = red_at_centre([0.0, 0.0, 1.0]);
    assert!(first > 2.0 * second && second > 2.0 * third && third > 0.0, "{first} {second} {third}");
}

/// Gaussians with a NaN or an infinity at any place are among the culled ones.
#[test]
fn culled_gaussians_change_nothing_and_are_counted() {
    let Some(device) = device() else { return };
    let host = random_scene(40, 6);
    let camera = [forward_camera(50, 37)];
    let good = [0.1, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.1, 0.5, 1.0, 0.0, 0.0];
    let with = |(index, value): (usize, f32)| {
        let mut g = good;
        g[index] = value;
        g
    };
    let not_finite = (0..14).flat_map(|index| NOT_FINITE.map(|value| (index, value)));
    let culled = [(2, -1.0), (2, 0.2), (0, 50.0), (10, 0.0), (10, -3.0), (3, 0.0), (12, 2e18)];
    let culled: Vec<[f32; 14]> = culled.into_iter().chain(not_finite).map(with).collect();
    let inserted = |added: &[[f32; 14]]| {
        let mut more = host.clone();
        more.gaussians.splice(20..20, added.iter().copied());
        more
    };
    for antialiased in [false, true] {
        let options = RenderOptions { antialiased, ..RenderOptions::inria() };
        let alone = pass(&host, &camera, &options, &device);
        let seen = pass(&inserted(&[good]), &camera, &options, &device);
        assert!(seen.image != alone.image, "it is visible without these values");
        let mut together = pass(&inserted(&culled), &camera, &options, &device);
        let before = alone.counts;
        let after = Counts {
            near: before.near + 2,
            outside: before.outside + 1,
            transparent: before.transparent + 2,
            degenerate: before.degenerate + 1,
            invalid: before.invalid + 1 + 3 * 14,
            ..before
        };
        assert_eq!(together.counts, after);
        let gradients: Vec<[f32; 14]> = together.gradient.splice(20..20 + culled.len(), []).collect();
        assert!(gradients.iter().flatten().all(|g| *g == 0.0));
        assert!(same_bits(&alone, &together));
    }
}

#[test]
fn nothing_to_see_leaves_the_background() {
    let Some(device) = device() else { return };
    let camera = [forward_camera(33, 17)];
    let mut transparent = random_scene(20, 7);
    transparent.gaussians.iter_mut().for_each(|g| g[10] = 0.0);
    let mut behind = random_scene(20, 7);
    behind.gaussians.iter_mut().for_each(|g| g[2] = -g[2]);
    let empty = HostScene { gaussians: Vec::new(), background: [0.2, 0.5, 0.9] };
    for host in [transparent, behind, empty] {
        let pass = pass(&host, &camera, &RenderOptions::inria(), &device);
        assert!(pass.image.chunks(5).all(|p| p == [0.2, 0.5, 0.9, 0.0, 0.0]));
        assert!(pass.gradient.iter().flatten().all(|g| *g == 0.0));
        assert!(pass.background.iter().all(|g| *g != 0.0));
        assert_eq!((pass.counts.visible, pass.counts.intersections), (0, 0));
    }
}

#[test]
fn several_views_are_the_same_as_each_alone() {
    let Some(device) = device() else { return };
    let host = random_scene(60, 9);
    let options = RenderOptions { antialiased: true, ..RenderOptions::gsplat_1_5() };
    let cameras = [0.0, 0.1, -0.2].map(|shift| {
        let mut camera = forward_camera(45, 35);
        camera.world_to_camera.translation.x = shift;
        camera
    });
    let upstream = random_upstream(3 * 45 * 35, 5);
    let together = host.pass(&cameras, &options, &upstream, &device);
    let share = 5 * 45 * 35;
    let mut sum = vec![[0.0_f32; 14]; 60];
    let mut visible = 0;
    for (i, camera) in cameras.iter().enumerate() {
        let part = i * share..(i + 1) * share;
        let alone = host.pass(std::slice::from_ref(camera), &options, &upstream[part.clone()], &device);
        assert!(alone.image == together.image[part], "view {i}");
        visible += alone.counts.visible;
        sum.iter_mut().flatten().zip(alone.gradient.iter().flatten()).for_each(|(s, g)| *s += g);
    }
    assert_eq!(visible, together.counts.visible);
    let (mut difference, mut norm) = (0.0, 0.0);
    for (s, g) in sum.iter().flatten().zip(together.gradient.iter().flatten()) {
        difference += f64::from(s - g).powi(2);
        norm += f64::from(*g).powi(2);
    }
    assert!(difference.sqrt() < 1e-6 * norm.sqrt(), "{difference} {norm}");
}

/// With one input tracked, its gradient is the same as with all, and the other inputs have none.
#[test]
fn untracked_inputs_get_no_gradient() {
    let Some(device) = device() else { return };
    let host = random_scene(80, 10);
    let cameras = [forward_camera(50, 37)];
    let tracking = device.clone().autodiff();
    let all = host.on(&tracking);
    let plain = host.on(&device);
    let backward = |gaussians: &Gaussians| {
        let color = render(gaussians, &cameras, &RenderOptions::inria()).expect("rendered").color;
        let weights = Tensor::<4>::from_data(
            burn::tensor::TensorData::new(random_upstream(50 * 37, 1)[..3 * 50 * 37].to_vec(), color.dims()),
            &color.device(),
        );
        (color * weights).sum().backward()
    };
    let full = backward(&all.gaussians());
    let expected = values(all.rows[3].grad(&full).expect("tracked"));
    for tracked in 0..5 {
        let lift = |index: usize| {
            let tensor = Tensor::<2>::from_data(plain.rows[index].to_data(), &tracking);
            if index == tracked { tensor.require_grad() } else { tensor }
        };
        let rows = [0, 1, 2, 3].map(lift);
        let opacities = Tensor::<1>::from_data(plain.opacities.to_data(), &tracking);
        let opacities = if tracked == 4 { opacities.require_grad() } else { opacities };
        let [means, rotations, scales, colors] = rows.clone();
        let gaussians = Gaussians::new(means, rotations, scales, opacities.clone(), colors).expect("shapes");
        let grads = backward(&gaussians);
        for (index, row) in rows.iter().enumerate() {
            let gradient = row.grad(&grads);
            assert_eq!(gradient.is_some(), index == tracked, "rows {index}, tracked {tracked}");
            if let Some(gradient) = gradient {
                let full = values(all.rows[index].grad(&full).expect("tracked"));
                assert!(values(gradient) == full, "rows {index}");
            }
        }
        assert_eq!(opacities.grad(&grads).is_some(), tracked == 4);
        if let Some(gradient) = opacities.grad(&grads) {
            assert!(values(gradient) == values(all.opacities.grad(&full).expect("tracked")));
        }
    }
    assert!(expected.iter().any(|g| *g != 0.0));
}

/// Pixels and gradients stay finite for any values, and every Gaussian is counted once.
#[test]
fn extreme_values_do_not_spread() {
    let Some(device) = device() else { return };
    let finite = [f32::MIN_POSITIVE / 2.0, -1e-40, 1e38, -1e38, f32::MAX, 0.0, -0.0, 1e18, -1e18, 1e-18];
    let poison = [&NOT_FINITE[..], &finite].concat();
    let camera = [forward_camera(31, 23)];
    let mut random = Random(99);
    for antialiased in [false, true] {
        let options = RenderOptions { antialiased, ..RenderOptions::inria() };
        let clean = random_scene(30, 13);
        // Each value at each place, many Gaussians at a time.
        for round in 0..14 {
            let mut host = clean.clone();
            for (i, value) in poison.iter().enumerate() {
                host.gaussians[2 * i][round] = *value;
                // Three in ten have a second extreme value.
                if random.uniform() < 0.3 {
                    let at = (random.uniform() * 14.0) as usize;
                    host.gaussians[2 * i][at] = poison[(random.uniform() * 13.0) as usize];
                }
            }
            let pass = pass(&host, &camera, &options, &device);
            // A visible colour of 1e18 makes a pixel of 1e18, which is finite.
            assert!(pass.image.iter().all(|p| p.is_finite()), "round {round}: pixels");
            for (i, gradient) in pass.gradient.iter().enumerate() {
                assert!(gradient.iter().all(|g| g.is_finite()), "round {round}: Gaussian {i}: {gradient:?}");
            }
            assert!(pass.background.iter().all(|g| g.is_finite()));
            let culled = pass.counts;
            let all = culled.visible + culled.near + culled.outside + culled.transparent;
            assert_eq!(
                all + culled.degenerate + culled.invalid,
                30,
                "round {round}: every Gaussian is counted once"
            );
        }
    }
}

/// 120,000 splats that each cover the whole image.
#[test]
fn many_full_screen_splats() {
    let Some(device) = device() else { return };
    let mut random = Random(17);
    let gaussian = |_| {
        let z = random.between(2.0, 6.0);
        let c: [f32; 3] = std::array::from_fn(|_| random.uniform());
        [0.0, 0.0, z, 1.0, 0.0, 0.0, 0.0, z, z, z, 0.02, c[0], c[1], c[2]]
    };
    let host = HostScene { gaussians: (0..120_000).map(gaussian).collect(), background: [0.0; 3] };
    let camera = [forward_camera(33, 20)];
    let pass = pass(&host, &camera, &RenderOptions::inria(), &device);
    assert_eq!(pass.counts.visible, 120_000);
    assert_eq!(pass.counts.intersections, 120_000 * 6);
    assert!(pass.image.iter().all(|p| p.is_finite()));
    assert!(
        pass.image.chunks(5).all(|p| p[3] > 0.999 && (0.3..0.7).contains(&p[0])),
        "an average of random colours"
    );
    assert!(pass.gradient.iter().flatten().all(|g| g.is_finite()));
    // Pixels close after some hundred splats. The splats behind have no gradient.
    let seen = pass.gradient.iter().filter(|g| g.iter().any(|v| *v != 0.0)).count();
    assert!((300..2000).contains(&seen), "{seen}");
}

/// More tiles than one axis of a GPU's launch grid has places: 33 views of 2048 tiles.
#[test]
fn more_than_65535_tiles() {
    let Some(device) = device() else { return };
    let mut random = Random(23);
    let camera = forward_camera(MAX_SIDE, 1);
    let gaussian = |_| {
        let (z, x) = (random.between(1.0, 2.0), random.between(-0.4, 0.4));
        [z * x, 0.0, z, 1.0, 0.0, 0.0, 0.0, 1e-3, 1e-3, 1e-3, 0.9, 1.0, 1.0, 1.0]
    };
    let host = HostScene { gaussians: (0..50).map(gaussian).collect(), background: [0.0; 3] };
    let options = RenderOptions::inria();
    let (one, all) =
        (pass(&host, &[camera], &options, &device), pass(&host, &[camera; 33], &options, &device));
    let last = all.image.len() - one.image.len();
    assert!(one.image.iter().any(|p| *p > 0.5));
    assert!(all.image[..last].chunks(one.image.len()).all(|view| view == one.image));
    assert!(all.image[last..] == one.image, "the last view, beyond the 65,535th tile");
    assert_eq!(all.counts.intersections, 33 * one.counts.intersections);
}

#[test]
fn unusable_cameras_and_options_are_refused() {
    let Some(device) = device() else { return };
    let gaussians = random_scene(3, 1).on(&device).gaussians();
    let camera = forward_camera(8, 8);
    let refused = |cameras: &[Camera], options: RenderOptions, expected: &str| {
        let error = render(&gaussians, cameras, &options).expect_err(expected).to_string();
        assert!(error.contains(expected), "{error}");
    };
    let inria = RenderOptions::inria;
    refused(&[], inria(), "no camera");
    refused(&[Camera { width: 0, ..camera }], inria(), "camera 0: `width`");
    refused(&[Camera { height: MAX_SIDE + 1, ..camera }], inria(), "camera 0: `height`");
    refused(&[camera, Camera { width: 9, ..camera }], inria(), "camera 1: its image is 9×8");
    let mut nan = camera;
    nan.focal.x = f64::NAN;
    refused(&[camera, nan], inria(), "camera 1: `fx`");
    refused(&[camera], RenderOptions { max_alpha: 1.0, ..inria() }, "`max_alpha`");
    refused(&[camera], RenderOptions { blur: f32::NAN, ..inria() }, "`blur`");
    refused(&[camera], RenderOptions { near: 0.0, ..inria() }, "`near`");
    let background = Some(Tensor::<1>::zeros([4], &device));
    refused(&[camera], RenderOptions { background, ..inria() }, "background");
}

/// An image beyond all memory is an error and does not end the process.
#[test]
fn images_beyond_all_memory_are_refused() {
    let Some(device) = device() else { return };
    let gaussians = random_scene(3, 1).on(&device).gaussians();
    let views = vec![forward_camera(MAX_SIDE, MAX_SIDE); 20_000];
    let error = render(&gaussians, &views, &RenderOptions::inria()).expect_err("344 TB");
    assert!(matches!(error, SplatError::Memory { .. }), "{error}");
}

/// Inputs of another precision are rendered in single precision.
#[test]
fn double_precision_inputs_give_the_same_image() {
    let Some(device) = device() else { return };
    if device_name() == "wgpu" {
        println!("SKIPPED: wgpu has no double precision");
        return;
    }
    let single = random_scene(30, 14).on(&device).gaussians();
    let double = Gaussians {
        means: single.means.clone().cast(burn::tensor::DType::F64),
        opacities: single.opacities.clone().cast(burn::tensor::DType::F64),
        ..single.clone()
    };
    let image = |gaussians: &Gaussians| {
        values(render(gaussians, &[forward_camera(20, 20)], &RenderOptions::inria()).expect("rendered").color)
    };
    assert!(image(&single) == image(&double));
}

/// Pairs of splats and tiles beyond the limit are counted, not computed: exactly, with few tiles per splat as with many.
#[test]
fn too_many_intersections_are_refused() {
    let Some(device) = device() else { return };
    let full_screen = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1e3, 1e3, 1e3, 0.9, 1.0, 1.0, 1.0];
    // More than 2³¹ pairs, and more than 2³⁰ with few tiles per splat.
    for (splats, side, views) in [(520, MAX_SIDE, 1), (600_000, 512, 2)] {
        let host = HostScene { gaussians: vec![full_screen; splats], background: [0.0; 3] };
        let cameras = vec![forward_camera(side, side); views];
        let rendered = render(&host.on(&device).gaussians(), &cameras, &RenderOptions::inria());
        let error = rendered.expect_err("too many");
        let SplatError::TooManyIntersections { found, limit } = error else { panic!("{error}") };
        // The CPU goes view by view.
        let counted = if is_on_gpu() { views } else { 1 };
        assert_eq!(found, (counted * splats) as u64 * u64::from(side / 16).pow(2));
        assert!(found > limit, "{found} of {limit}");
    }
}
