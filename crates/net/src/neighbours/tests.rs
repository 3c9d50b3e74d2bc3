use rand::{RngCore, SeedableRng, seq::SliceRandom};

use super::*;

/// Numbers in [0, 1).
pub fn random(seed: u64) -> impl FnMut() -> f32 {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    move || (random.next_u32() >> 8) as f32 / (1 << 24) as f32
}

/// Points of the unit ball.
fn ball(n: usize, seed: u64) -> Vec<[f32; 3]> {
    let mut next = random(seed);
    let cube = std::iter::from_fn(|| Some([next(), next(), next()].map(|v| 2.0 * v - 1.0)));
    cube.filter(|p| distance(p, &[0.0; 3]) <= 1.0).take(n).collect()
}

/// Points of the unit sphere.
pub fn directions(n: usize, seed: u64) -> Vec<[f32; 3]> {
    let off_centre = |p: &[f32; 3]| distance(p, &[0.0; 3]) > 1e-3;
    let points = ball(2 * n + 10, seed).into_iter().filter(off_centre).take(n);
    points.map(|p| p.map(|v| v / distance(&p, &[0.0; 3]).sqrt())).collect()
}

fn moved(points: Vec<[f32; 3]>, scale: f32, by: [f32; 3]) -> Vec<[f32; 3]> {
    points.into_iter().map(|p| std::array::from_fn(|k| scale * p[k] + by[k])).collect()
}

pub fn distance(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    let [x, y, z]: [f32; 3] = std::array::from_fn(|k| a[k] - b[k]);
    (x * x + y * y) + z * z
}

/// The definition.
fn nearest(points: &[[f32; 3]], query: &[f32; 3]) -> u32 {
    let rows = points.iter().zip(0..).map(|(p, row)| (distance(p, query), row));
    rows.fold((f32::INFINITY, 0), |best, this| if this.0 < best.0 { this } else { best }).1
}

fn check(name: &str, points: &[[f32; 3]], queries: &[[f32; 3]]) {
    let found = Neighbours::new(points).expect("points").nearest(queries);
    for (i, (query, found)) in queries.iter().zip(found).enumerate() {
        assert_eq!(found, nearest(points, query), "{name}: query {i} at {query:?}");
    }
}

/// Two sheets facing each other in the unit cube, 2 cm rough, row by row.
fn sheets(side: usize, seed: u64) -> Vec<[f32; 3]> {
    let mut next = random(seed);
    let pixels = (0..2 * side * side).map(|i| (i / (side * side), i / side % side, i % side));
    pixels
        .map(|(z, y, x)| [x as f32 / side as f32, y as f32 / side as f32, z as f32 + 0.02 * next()])
        .collect()
}

fn line(n: usize, seed: u64) -> Vec<[f32; 3]> {
    let mut next = random(seed);
    (0..n).map(|_| next()).map(|t| [t, 0.7 * t, -0.4 * t]).collect()
}

#[test]
fn volumes_and_surfaces_are_searched_exactly() {
    let queries = ball(700, 1);
    check("volume", &ball(3000, 2), &queries);
    check("sheets", &sheets(40, 3), &queries);
    check("sphere around", &directions(3000, 4), &moved(queries.clone(), 0.1, [0.0; 3]));
    check("sphere around a spot", &directions(3000, 4), &moved(queries.clone(), 1e-6, [0.0; 3]));
    check("line", &line(3000, 5), &queries);
    for n in [1, 2, LANES - 1, LANES, LANES + 1, 5 * LANES + 7] {
        check("few", &ball(n, 6), &queries);
        check("few queries", &ball(1000, 7), &queries[..n]);
    }
}

#[test]
fn far_queries_are_searched_exactly() {
    for away in [10.0, 1e3, 1e6, 1e12, 1e18] {
        check("far", &sheets(40, 8), &moved(ball(300, 9), away, [2.0 * away, away, -away]));
    }
}

#[test]
fn the_first_of_equals_wins() {
    let mut next = random(10);
    let mut lattice = |n: usize| -> Vec<[f32; 3]> {
        (0..n).map(|_| [next(), next(), next()].map(|v| (8.0 * v).floor())).collect()
    };
    let (points, corners) = (lattice(3000), lattice(500));
    check("lattice", &points, &moved(corners.clone(), 1.0, [0.5; 3]));
    check("lattice from afar", &points, &moved(corners, 1000.0, [2000.5; 3]));
    check("all the same", &vec![[1.0, 2.0, 3.0]; 3000], &ball(300, 11));
    check("same queries", &points, &vec![[3.5; 3]; 300]);
}

#[test]
fn clusters_of_any_scale_are_searched_exactly() {
    let mut next = random(12);
    let mut scales = |n: usize, low: f32, high: f32, seed: u64| -> Vec<[f32; 3]> {
        directions(n, seed)
            .into_iter()
            .map(|p| p.map(|v| v * 10f32.powf(low + (high - low) * next())))
            .collect()
    };
    let mut points = moved(ball(1000, 13), 1e-6, [0.0; 3]);
    points.extend(moved(ball(1000, 14), 1e6, [1e6; 3]));
    let mut queries = moved(ball(200, 15), 1e-6, [0.0; 3]);
    queries.extend(moved(ball(200, 16), 1e6, [0.0; 3]));
    check("two clusters", &points, &queries);
    // Squares overflow from 2e19 on and lose digits below 1e-19; denormals are below 1e-38.
    check("all of f32", &scales(2000, -44.0, 38.0, 17), &scales(500, -44.0, 38.0, 18));
    check("around overflow", &scales(2000, 17.0, 21.0, 19), &scales(500, 17.0, 21.0, 20));
    check("around underflow", &scales(2000, -26.0, -17.0, 21), &scales(500, -26.0, -17.0, 22));
}

#[test]
fn where_all_distances_overflow_the_first_point_is_nearest() {
    let neighbours = Neighbours::new(&moved(ball(1000, 23), 1e30, [0.0; 3])).expect("points");
    assert_eq!(neighbours.nearest(&[[-3e38; 3], [3e38, 0.0, 0.0]]), [0, 0]);
}

#[test]
fn points_that_are_not_finite_are_no_neighbours() {
    let far = [f32::NAN, f32::INFINITY].map(|x| [x, 0.0, 0.0]);
    assert!(Neighbours::new(&[]).is_none() && Neighbours::new(&far).is_none());
    let all = [far[0], [5.0; 3], far[1], [1.0; 3]];
    assert_eq!(Neighbours::new(&all).expect("two points").nearest(&[[0.0; 3], [4.0; 3]]), [3, 1]);
}

#[test]
fn queries_that_are_not_finite_get_the_first_point_and_cost_nothing() {
    let neighbours = Neighbours::new(&ball(1000, 24)).expect("points");
    let mut queries = vec![[f32::NAN, 0.0, 0.0], [0.0, f32::INFINITY, 0.0], [f32::NEG_INFINITY; 3]];
    let (rows, work) = neighbours.search(&queries);
    assert_eq!((rows, work.boxes, work.leaves), (vec![0; 3], 0, 0));
    queries.push(ball(1000, 24)[700]);
    assert_eq!(neighbours.nearest(&queries), [0, 0, 0, 700]);
    assert!(Neighbours::new(&[]).is_none());
}

#[test]
fn answers_depend_neither_on_threads_nor_on_the_order_of_queries() {
    let (points, queries) = (sheets(60, 25), ball(20_000, 26));
    let answers = |threads: usize, queries: &[[f32; 3]]| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| Neighbours::new(&points).expect("points").nearest(queries))
    };
    let alone = answers(1, &queries);
    assert_eq!(alone, answers(3, &queries));
    let mut order: Vec<usize> = (0..queries.len()).collect();
    order.shuffle(&mut rand_chacha::ChaCha8Rng::seed_from_u64(27));
    let shuffled: Vec<[f32; 3]> = order.iter().map(|&i| queries[i]).collect();
    let expected: Vec<u32> = order.iter().map(|&i| alone[i]).collect();
    assert_eq!(answers(2, &shuffled), expected);
}

/// Bounds are 1.5 times the counted figures; a search through everything tests 625 boxes and computes 10,000 distances, which
/// is what the middle of a sphere costs.
#[test]
fn geometry_of_any_kind_costs_little() {
    const N: usize = 10_000;
    let around = |scale: f32, by: [f32; 3]| moved(ball(N, 28), scale, by);
    let cases = [
        ("beside sheets", sheets(70, 29), around(1.0, [1.5, 0.5, 0.5]), [75.0, 400.0]),
        ("from all around", sheets(70, 29), around(1000.0, [0.0; 3]), [55.0, 210.0]),
        ("from one side", sheets(70, 29), around(300.0, [600.0, 10.0, 50.0]), [55.0, 200.0]),
        ("blobs apart", ball(N, 30), around(1.0, [100.0, 0.0, 0.0]), [26.0, 50.0]),
        ("sphere around", directions(N, 31), around(0.1, [0.0; 3]), [626.0, 10_001.0]),
        ("line", line(N, 32), around(1.0, [0.0; 3]), [1e9, 1e9]),
        ("all the same", vec![[1.0; 3]; N], around(1.0, [0.0; 3]), [2.0, 50.0]),
        ("one query", directions(N, 33), vec![[0.0; 3]; N], [1e9, 1e9]),
    ];
    for (name, points, queries, most) in cases {
        let (_, work) = Neighbours::new(&points).expect("points").search(&queries);
        let boxes = (work.boxes as usize * LANES) as f64 / N as f64;
        let distances = (work.leaves as usize * LANES * LANES) as f64 / N as f64;
        println!("{name}: {boxes:.1} boxes, {distances:.1} distances per query");
        assert!(boxes < most[0] && distances < most[1], "{name}: {boxes:.1} boxes, {distances:.1} distances");
    }
}
