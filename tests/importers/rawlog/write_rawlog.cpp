// Writes the tables of a drive as a rawlog, with MRPT: see ../test_import_rawlog.py.
// Built with CMake: find_package(mrpt-obs), target_link_libraries(write_rawlog mrpt::obs).
#include <mrpt/io/CFileGZOutputStream.h>
#include <mrpt/obs/CActionCollection.h>
#include <mrpt/obs/CActionRobotMovement2D.h>
#include <mrpt/obs/CObservation2DRangeScan.h>
#include <mrpt/obs/CObservationComment.h>
#include <mrpt/obs/CObservationIMU.h>
#include <mrpt/obs/CObservationOdometry.h>
#include <mrpt/obs/CObservationRange.h>
#include <mrpt/obs/CSensoryFrame.h>
#include <mrpt/serialization/CArchive.h>

#include <fstream>
#include <map>
#include <sstream>

using namespace mrpt::obs;
using Row = std::vector<double>;

static mrpt::Clock::time_point stamp(long long ns)
{
	return mrpt::Clock::time_point(mrpt::Clock::duration(ns / 100 + 116444736000000000LL));
}

// stamp ns -> the numbers after it
static std::map<long long, Row> table(const std::string& path)
{
	std::map<long long, Row> rows;
	std::ifstream file(path);
	for (std::string line; std::getline(file, line);)
	{
		std::istringstream fields(line);
		long long ns;
		fields >> ns;
		for (std::string one; fields >> one;) rows[ns].push_back(std::stod(one));
	}
	return rows;
}

int main(int, char** argv)
{
	const std::string folder = argv[1], form = argv[2];
	const bool pairs = form == "pairs";
	auto odometry = table(folder + "/odometry.txt"), scans = table(folder + "/scans.txt");
	auto rates = table(folder + "/rates.txt");
	const Row mount = table(folder + "/mount.txt")[0];
	mrpt::io::CFileGZOutputStream file(argv[3], mrpt::io::OpenMode::TRUNCATE, 9);
	auto out = mrpt::serialization::archiveFrom(file);

	if (!pairs)
	{
		CObservationComment comment;
		comment.text = "a drive in a simulated room";
		out << comment;
	}
	mrpt::poses::CPose2D before(0, 0, 0);
	for (const auto& [ns, pose] : odometry)
	{
		const mrpt::poses::CPose2D now(pose[0], pose[1], pose[2]);
		CSensoryFrame frame;
		auto imu = CObservationIMU::Create();
		imu->timestamp = stamp(ns);
		imu->sensorLabel = "gyro";
		imu->set(IMU_WZ, rates[ns][0]);
		frame.insert(imu);
		if (scans.count(ns))
		{
			const Row& row = scans[ns];
			auto scan = CObservation2DRangeScan::Create();
			scan->timestamp = stamp(ns);
			scan->sensorLabel = "front laser";
			scan->sensorPose = mrpt::poses::CPose3D(mount[0], mount[1], 0, mount[2], 0, 0);
			scan->aperture = row[0];
			scan->maxRange = row[1];
			scan->rightToLeft = pairs;
			const size_t beams = row.size() - 2;
			scan->resizeScan(beams);
			for (size_t k = 0; k < beams; k++)
			{
				const float range = row[2 + (pairs ? k : beams - 1 - k)];
				scan->setScanRange(k, range);
				scan->setScanRangeValidity(k, range > 0);
			}
			frame.insert(scan);
			auto sonar = CObservationRange::Create();
			sonar->timestamp = stamp(ns);
			sonar->sensedData.resize(1);
			sonar->sensedData[0].sensedDistance = 1;
			frame.insert(sonar);
		}
		if (pairs)
		{
			CActionRobotMovement2D motion;
			motion.computeFromOdometry(now - before, {});
			motion.timestamp = stamp(ns);
			CActionCollection actions;
			actions.insert(motion);
			out << actions << frame;
		}
		else
		{
			CObservationOdometry reading;
			reading.odometry = now;
			reading.sensorLabel = "wheels";
			reading.timestamp = stamp(ns);
			out << reading;
			for (const auto& one : frame) out << *one;
		}
		before = now;
	}
}
