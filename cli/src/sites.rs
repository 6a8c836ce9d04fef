//! What a Site says of its floor is in files beside its manifest, a map_server map; it is read here and becomes part of the object.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use muster_api::kind::site::SiteGrid;
use muster_api::map::{Gray, Grid, MapError, MapFile};
use muster_api::validate::Violations;
use serde_json::Value;

/// The field that names the map.
const MAP_FILE: &str = "mapFile";

/// Why a map is not read.
#[derive(Debug, thiserror::Error)]
enum ReadError {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{path}: {source}")]
    Map { path: PathBuf, source: MapError },
    #[error("{path}: is no PNG image: {reason}")]
    Png { path: PathBuf, reason: String },
}

/// Puts what the `mapFile` of a Site says into its `grid`. `source` is the manifest's path; relative names are beside it. Objects of
/// other kinds stay as they are.
///
/// # Errors
///
/// Which file is no map, and where in it.
pub(crate) fn read_map(object: &mut Value, source: &str) -> Result<(), Violations> {
    if object["kind"] != "Site" || object["apiVersion"] != muster_api::API_VERSION {
        return Ok(());
    }
    let Some(spec) = object.get_mut("spec").and_then(Value::as_object_mut) else { return Ok(()) };
    let Some(file) = spec.get(MAP_FILE).and_then(Value::as_str) else { return Ok(()) };
    let mut violations = Violations::new();
    if spec.contains_key("grid") {
        violations
            .forbidden("spec.mapFile", "spec.grid says what the floor is already")
            .suggest("leave out one of the two");
        return violations.into_result(());
    }
    let path = Path::new(source).parent().unwrap_or_else(|| Path::new("")).join(file);
    match read(&path) {
        Ok(grid) => {
            spec.remove(MAP_FILE);
            let grid = serde_json::to_value(SiteGrid::of(&grid)).expect("numbers and a text");
            spec.insert("grid".to_owned(), grid);
        }
        Err(error) => drop(violations.invalid("spec.mapFile", error.to_string())),
    }
    violations.into_result(())
}

fn read(path: &Path) -> Result<Grid, ReadError> {
    let io = |path: &Path| {
        let path = path.to_owned();
        move |source| ReadError::Io { path, source }
    };
    let map = |path: &Path| {
        let path = path.to_owned();
        move |source| ReadError::Map { path, source }
    };
    let text = std::fs::read_to_string(path).map_err(io(path))?;
    let file = MapFile::parse(&text).map_err(map(path))?;
    let image = path.parent().unwrap_or_else(|| Path::new("")).join(&file.image);
    let is_png = image.extension().is_some_and(|end| end.eq_ignore_ascii_case("png"));
    let gray = if is_png {
        png(&image)?
    } else {
        Gray::pgm(&std::fs::read(&image).map_err(io(&image))?).map_err(map(&image))?
    };
    Ok(file.grid(&gray))
}

/// A PNG image as map_server reads one: the mean of its colors; what is transparent is as it is painted.
fn png(path: &Path) -> Result<Gray, ReadError> {
    let wrong = |error: png::DecodingError| ReadError::Png {
        path: path.to_owned(),
        reason: error.to_string(),
    };
    let file =
        File::open(path).map_err(|source| ReadError::Io { path: path.to_owned(), source })?;
    let mut decoder = png::Decoder::new(BufReader::new(file));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(wrong)?;
    let info = reader.info();
    let too_large = |width: u32, height: u32| {
        let source = MapError::Size { width: width.into(), height: height.into() };
        ReadError::Map { path: path.to_owned(), source }
    };
    let (width, height) = (info.width, info.height);
    if u64::from(width) * u64::from(height) > muster_api::map::MOST_CELLS {
        return Err(too_large(width, height));
    }
    let size = reader.output_buffer_size().ok_or_else(|| too_large(width, height))?;
    let mut bytes = vec![0; size];
    let frame = reader.next_frame(&mut bytes).map_err(wrong)?;
    let (samples, colors) = match frame.color_type {
        png::ColorType::Grayscale | png::ColorType::Indexed => (1, 1),
        png::ColorType::GrayscaleAlpha => (2, 1),
        png::ColorType::Rgb => (3, 3),
        png::ColorType::Rgba => (4, 3),
    };
    let mean = |pixel: &[u8]| {
        let sum: u32 = pixel[..colors].iter().map(|part| u32::from(*part)).sum();
        u8::try_from(sum as usize / colors).unwrap_or(u8::MAX)
    };
    let pixels = bytes[..frame.buffer_size()].chunks_exact(samples).map(mean).collect();
    Gray::new(width, height, pixels)
        .map_err(|source| ReadError::Map { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    const MAP: &str = "resolution: 0.5\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n";

    fn site(dir: &Path, image: &str) -> Result<Value, String> {
        std::fs::write(dir.join("lab.yaml"), format!("image: {image}\n{MAP}")).unwrap();
        let mut object = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Site", "metadata": {"name": "lab"},
            "spec": {"mapFile": "lab.yaml"},
        });
        let read = read_map(&mut object, &dir.join("site.yaml").display().to_string());
        read.map_err(|all| all.iter().map(ToString::to_string).collect::<String>())?;
        Ok(object)
    }

    #[test]
    fn a_map_beside_the_manifest_becomes_its_grid() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("lab.pgm"), b"P5 3 1 255\n\xfe\xcd\x00").unwrap();
        let object = site(dir.path(), "lab.pgm").unwrap();
        assert_eq!(object["spec"]["grid"]["cells"], "fuo");
        assert!(object["spec"].get("mapFile").is_none());
        muster_api::kind::admit(&object).expect("the controller takes it");
        let file = File::create(dir.path().join("lab.png")).unwrap();
        let mut encoder = png::Encoder::new(file, 3, 1);
        encoder.set_color(png::ColorType::Rgb);
        let mut writer = encoder.write_header().unwrap();
        writer.write_image_data(&[254, 254, 254, 205, 205, 205, 0, 0, 0]).unwrap();
        writer.finish().unwrap();
        assert_eq!(site(dir.path(), "lab.png").unwrap()["spec"]["grid"]["cells"], "fuo");
    }

    #[test]
    fn the_lab_s_site_is_taken() {
        let lab = concat!(env!("CARGO_MANIFEST_DIR"), "/../manifests/lab");
        let path = PathBuf::from(format!("{lab}/site.yaml"));
        let all = crate::manifests::load(&[path], "default", false).expect("a Site");
        let [site] = all.as_slice() else { panic!("{all:?}") };
        assert_eq!(site.title(), "site/lab");
        assert_eq!(site.written["spec"]["grid"]["width"], 120);
    }

    #[test]
    fn what_is_no_map_is_said_with_its_file() {
        let dir = tempfile::tempdir().unwrap();
        let refusal = |image: &str| site(dir.path(), image).unwrap_err();
        assert!(refusal("none.pgm").contains("none.pgm"), "{}", refusal("none.pgm"));
        std::fs::write(dir.path().join("bad.pgm"), b"P5 3 1 255\n\xfe").unwrap();
        assert!(
            refusal("bad.pgm").contains("bad.pgm: at byte 12: is no PGM image"),
            "{}",
            refusal("bad.pgm")
        );
        std::fs::write(dir.path().join("bad.png"), b"P5").unwrap();
        assert!(refusal("bad.png").contains("bad.png: is no PNG image"), "{}", refusal("bad.png"));
    }
}
