//! Skeletons of people against the truth: joints, and the person in another pose.

use std::error::Error;
use std::path::Path;

use burn::tensor::Device;
use serde_json::json;
use snapsnap_mesh::fuse::{Options, fuse};
use snapsnap_people::Detail;
use snapsnap_people::makehuman::{Library, rigged};
use snapsnap_rig::Rig;
use snapsnap_splat::scene::Stored;

fn main() -> Result<(), Box<dyn Error>> {
    let a: Vec<String> = std::env::args().skip(1).collect();
    let library = Library::open(Path::new(&a[1]))?;
    let count: usize = a[3].parse()?;
    for index in 0..count {
        let path = Path::new(&a[0]).join(format!("{index:04}.ply"));
        if !path.exists() {
            continue;
        }
        let scene = Stored::read(&path)?.load(&Device::flex());
        let fused = fuse(&scene, Options::default(), &|_| {})?;
        let since = std::time::Instant::now();
        let rig = Rig::new(&scene, &fused.mesh)?;
        let time = since.elapsed().as_secs_f64();
        let (mesh, bones) = rigged(&library, &format!("{}/{index}", a[2]), None, None, Detail::Coarse)?;
        let (low, high) = mesh.bounds();
        println!(
            "{}",
            json!({
                "index": index, "time": time, "height": high.y - low.y,
                "rig": rig.bones.iter().map(|b| (b.name.clone(), json!([b.ends[0].to_array(), b.ends[1].to_array(), b.is_sure]))).collect::<serde_json::Map<_, _>>(),
                "bones": bones.iter().map(|b| (b.name.clone(), json!(b.place.to_array()))).collect::<serde_json::Map<_, _>>(),
            })
        );
    }
    Ok(())
}
