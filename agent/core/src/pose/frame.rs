//! Rigid transforms in three dimensions, metres and radians.

use std::str::FromStr;

use muster_api::pose::Covariance;
use nalgebra::{Isometry3, Matrix6, Quaternion, Translation3, UnitQuaternion, Vector3};

/// A rotation, then a translation.
pub type Transform = Isometry3<f64>;

/// Shorter than this a quaternion has no direction; ROS's tools call one wrong that is more than a tenth off 1.
const LEAST_NORM: f64 = 1e-3;

/// A transform from a message's numbers: translation, and quaternion as x, y, z, w. A quaternion that is not of length 1
/// is made so, as tf does. `None`: a number is not finite, or the quaternion is zero, as nobody set it.
#[must_use]
pub fn transform([x, y, z]: [f64; 3], [i, j, k, w]: [f64; 4]) -> Option<Transform> {
    let rotation = Quaternion::new(w, i, j, k);
    let finite = [x, y, z, i, j, k, w].iter().all(|number| number.is_finite());
    (finite && rotation.norm() >= LEAST_NORM).then(|| {
        Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(rotation))
    })
}

/// Heading: radians counter-clockwise around z from the x axis, (−π, π]; yaw of the fixed-axis angles roll, pitch, yaw.
#[must_use]
pub fn yaw(of: &Transform) -> f64 {
    of.rotation.euler_angles().2
}

/// A covariance of x, y, z and rotations about x, y, z (REP 103, row-major as in `geometry_msgs/PoseWithCovariance`), said
/// in a parent frame, in the frame that `by` turns that parent's coordinates into: its floor part. `None`: all zero, or
/// not finite, as publishers send that do not know; or of variances that no measurement has (a driver's "infinity").
#[must_use]
pub fn covariance(of: &[f64; 36], by: &Transform) -> Option<Covariance> {
    let matrix = Matrix6::from_row_slice(of);
    if !matrix.iter().all(|n| n.is_finite()) || matrix.iter().all(|n| *n == 0.0) {
        return None;
    }
    let rotation = by.rotation.to_rotation_matrix();
    let turned = |block: nalgebra::Matrix3<f64>| rotation * block * rotation.transpose();
    let position = turned(matrix.fixed_view::<3, 3>(0, 0).into_owned());
    let heading = turned(matrix.fixed_view::<3, 3>(3, 3).into_owned());
    let floor = Covariance {
        xx: position[(0, 0)],
        xy: position[(0, 1)],
        yy: position[(1, 1)],
        yaw: heading[(2, 2)],
    };
    [floor.xx, floor.xy, floor.yy, floor.yaw].iter().all(|n| n.is_finite()).then_some(floor)
}

/// A transform in the settings: `X,Y,YAW`, or `X,Y,Z,ROLL,PITCH,YAW` as `static_transform_publisher` has them: metres, and
/// radians about the fixed axes x, y, z, in this order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Offset(pub Transform);

/// Why a text is no [`Offset`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} is no transform; write X,Y,YAW or X,Y,Z,ROLL,PITCH,YAW (metres, radians), as in 3.0,4.5,1.57"
)]
pub struct OffsetError(String);

impl FromStr for Offset {
    type Err = OffsetError;

    fn from_str(text: &str) -> Result<Self, OffsetError> {
        let number = |part: &str| part.trim().parse().ok().filter(|n: &f64| n.is_finite());
        let numbers: Option<Vec<f64>> = text.split(',').map(number).collect();
        let of = |x, y, z, roll, pitch, yaw| {
            let rotation = Vector3::new(roll, pitch, yaw);
            let rotation = UnitQuaternion::from_euler_angles(rotation.x, rotation.y, rotation.z);
            Offset(Isometry3::from_parts(Translation3::new(x, y, z), rotation))
        };
        match numbers.as_deref() {
            Some([x, y, yaw]) => Ok(of(*x, *y, 0.0, 0.0, 0.0, *yaw)),
            Some([x, y, z, roll, pitch, yaw]) => Ok(of(*x, *y, *z, *roll, *pitch, *yaw)),
            _ => Err(OffsetError(text.to_owned())),
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use proptest::prelude::*;

    use super::*;

    #[test]
    fn an_offset_is_three_or_six_numbers() {
        let flat: Offset = "3, 4,1.5".parse().unwrap();
        let full: Offset = "3,4,0,0,0,1.5".parse().unwrap();
        assert_eq!(flat, full);
        assert!((yaw(&flat.0) - 1.5).abs() < 1e-12);
        for bad in ["", "1,2", "1,2,3,4", "1,2,3,4,5,inf", "a,b,c", "1,2,3,4,5,6,7"] {
            assert!(bad.parse::<Offset>().is_err(), "{bad}");
        }
    }

    /// `static_transform_publisher 1 2 3 0.3 0.2 0.1 map odom` (x y z yaw pitch roll), by hand: Rz(yaw) Ry(pitch) Rx(roll).
    #[test]
    fn angles_are_about_fixed_axes_in_the_order_of_ros() {
        let Offset(made) = "1,2,3,0.1,0.2,0.3".parse().unwrap();
        let axis = |axis: Vector3<f64>, angle: f64| UnitQuaternion::from_scaled_axis(axis * angle);
        let by_hand = axis(Vector3::z(), 0.3) * axis(Vector3::y(), 0.2) * axis(Vector3::x(), 0.1);
        assert!(made.rotation.angle_to(&by_hand) < 1e-12);
        assert_eq!(made.translation.vector, Vector3::new(1.0, 2.0, 3.0));
    }

    #[test]
    fn what_nobody_set_is_no_transform() {
        assert_eq!(transform([1.0, 2.0, 3.0], [0.0; 4]), None);
        assert_eq!(transform([f64::NAN, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]), None);
        let long = transform([0.0; 3], [0.0, 0.0, 2.0, 2.0]).unwrap();
        assert!((yaw(&long) - FRAC_PI_2).abs() < 1e-12, "a quaternion is made of length 1");
    }

    #[test]
    fn a_covariance_turns_with_its_frame() {
        let mut of = [0.0; 36];
        (of[0], of[7], of[35]) = (4.0, 1.0, 0.25);
        let Offset(quarter) = "5,6,1.5707963267948966".parse().unwrap();
        let turned = covariance(&of, &quarter).unwrap();
        assert!((turned.xx - 1.0).abs() < 1e-9 && (turned.yy - 4.0).abs() < 1e-9, "{turned:?}");
        assert!(turned.xy.abs() < 1e-9 && (turned.yaw - 0.25).abs() < 1e-9);
        assert_eq!(covariance(&[0.0; 36], &quarter), None, "nobody set it");
        of[0] = f64::INFINITY;
        assert_eq!(covariance(&of, &quarter), None);
    }

    prop_compose! {
        pub(crate) fn any_transform()(
            at in prop::array::uniform3(-50.0..50.0f64),
            angles in prop::array::uniform3(-PI..PI),
        ) -> Transform {
            let [roll, pitch, yaw] = angles;
            Isometry3::from_parts(at.into(), UnitQuaternion::from_euler_angles(roll, pitch, yaw))
        }
    }

    proptest! {
        /// Standing somewhere in `odom`, the robot is in `map` where the same point is.
        #[test]
        fn composition_is_that_of_points(map_from_odom in any_transform(), odom_from_base in any_transform()) {
            let robot = map_from_odom * odom_from_base;
            let point = nalgebra::Point3::new(0.3, -0.2, 0.1);
            let one = robot * point;
            let other = map_from_odom * (odom_from_base * point);
            prop_assert!(nalgebra::distance(&one, &other) < 1e-9);
            let back = map_from_odom.inverse() * robot;
            prop_assert!((back.translation.vector - odom_from_base.translation.vector).norm() < 1e-9);
        }

        /// A turn changes no variance's sum, and the worst deviation of a level turn stays.
        #[test]
        fn a_level_turn_keeps_the_deviation(angle in -PI..PI, xx in 0.0..4.0f64, yy in 0.0..4.0f64) {
            let mut of = [0.0; 36];
            (of[0], of[7], of[35]) = (xx + 1e-3, yy + 1e-3, 0.1);
            let turn = Isometry3::new(Vector3::zeros(), Vector3::z() * angle);
            let (before, after) = (covariance(&of, &Isometry3::identity()), covariance(&of, &turn));
            let (before, after) = (before.unwrap(), after.unwrap());
            prop_assert!((before.deviation() - after.deviation()).abs() < 1e-9);
        }
    }
}
