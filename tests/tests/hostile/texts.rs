use std::fmt::{Debug, Display};
use std::str::FromStr;

use muster_api::map::{Gray, MapFile};
use muster_api::quantity::{BitRate, Bytes, MilliCpu, QuantityError};
use muster_api::selector::{FieldSelector, LabelSelector};
use serde_json::json;

/// What is read is printed so that it is read the same.
fn there_and_back<T>(text: &str)
where
    T: FromStr<Err = QuantityError> + Display + Debug + PartialEq,
{
    match T::from_str(text) {
        Ok(quantity) => {
            assert_eq!(T::from_str(&quantity.to_string()).as_ref(), Ok(&quantity), "{text:?}")
        }
        Err(error) => assert!(!error.to_string().is_empty() && !error.suggestion().is_empty()),
    }
}

#[test]
fn quantities_are_read_as_they_are_printed() {
    let inputs = muster_hostile::inputs("quantities");
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let text = String::from_utf8_lossy(bytes);
        there_and_back::<MilliCpu>(&text);
        there_and_back::<Bytes>(&text);
        there_and_back::<BitRate>(&text);
    });
}

#[test]
fn selectors_select_or_are_refused() {
    let object = json!({"metadata": {"name": "tb-1", "labels": {"floor": "2"}}, "status": {"phase": "Running"}});
    let labels = [("floor".to_owned(), "2".to_owned())].into();
    let inputs = muster_hostile::inputs("selectors");
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let text = String::from_utf8_lossy(bytes);
        match LabelSelector::parse(&text) {
            Ok(selector) => {
                let selects = selector.matches(&labels);
                let again = serde_json::to_value(&selector).unwrap();
                let again: LabelSelector = serde_json::from_value(again).unwrap();
                assert_eq!(again.matches(&labels), selects, "{text:?}");
            }
            Err(error) => assert!(!error.to_string().is_empty()),
        }
        if let Ok(selector) = FieldSelector::parse(&text) {
            drop(format!("{}", selector.matches(&object)));
        }
    });
}

#[test]
fn maps_have_the_cells_that_they_say() {
    let inputs = muster_hostile::inputs("maps");
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let settings = MapFile::parse(&String::from_utf8_lossy(bytes));
        let usual = || {
            MapFile::parse(
                "image: a.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
            )
        };
        let settings = settings.or_else(|_| usual()).expect("it is a map");
        let Ok(image) = Gray::pgm(bytes) else { return };
        let grid = settings.grid(&image);
        assert_eq!(grid.cells.len() as u64, u64::from(grid.width) * u64::from(grid.height));
        assert_eq!(grid.at(f64::MAX, f64::MIN), None);
    });
}
